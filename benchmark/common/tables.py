# SPDX-License-Identifier: Apache-2.0
"""Tables, and the machine they were measured on."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence

import numpy as np
import scipy

import quadtree_lss
from quadtree_lss.desk.replay.results import aligned


def machine() -> str:
    """Cores and versions in one line; empty for the documents, which state build and date."""
    if os.environ.get("TABLES") == "markdown":
        return ""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return (
        f"{platform.machine()}, {cores} cores, Python {platform.python_version()},"
        f" NumPy {np.__version__}, SciPy {scipy.__version__},"
        f" quadtree_lss {quadtree_lss.__version__}."
    )


def table(title: str, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Print a table, with ``TABLES=markdown`` as Markdown for the documents."""
    if os.environ.get("TABLES") == "markdown":
        lines = [header, ["---"] * len(header), *rows]
        print(f"\n{title}\n")
        texts = ([str(cell).replace("|", "\\|") for cell in line] for line in lines)
        print("\n".join(f"| {' | '.join(text)} |" for text in texts) + "\n")
        return
    cells = [[str(cell) for cell in row] for row in (header, *rows)]
    cells.insert(1, ["-" * max(map(len, column)) for column in zip(*cells, strict=True)])
    print("\n".join([f"\n{title}", *aligned(cells)]))
