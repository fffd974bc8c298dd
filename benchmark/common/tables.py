# SPDX-License-Identifier: Apache-2.0
"""Aligned tables, and what they were measured on."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence

import numpy as np
import scipy

import quadtree_lss


def machine() -> str:
    """Cores and versions, in one line."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return (
        f"{platform.machine()}, {cores} cores, Python {platform.python_version()},"
        f" NumPy {np.__version__}, SciPy {scipy.__version__},"
        f" quadtree_lss {quadtree_lss.__version__}."
    )


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print ``rows`` under ``header``: first column to the left, the others to the right.

    With ``TABLES=markdown`` as Markdown, for the documents.
    """
    if os.environ.get("TABLES") == "markdown":
        lines = [header, ["---"] * len(header), *rows]
        print(f"\n{title}\n")
        texts = ([str(cell).replace("|", "\\|") for cell in line] for line in lines)
        print("\n".join(f"| {' | '.join(text)} |" for text in texts) + "\n")
        return
    cells = [list(map(str, header)), *[[str(cell) for cell in row] for row in rows]]
    width = [max(len(row[k]) for row in cells) for k in range(len(header))]
    print(f"\n{title}")
    for n, row in enumerate(cells):
        first, rest = row[0].ljust(width[0]), zip(row[1:], width[1:], strict=True)
        print("  ".join([first, *[cell.rjust(w) for cell, w in rest]]).rstrip())
        if n == 0:
            print("  ".join("-" * w for w in width))
