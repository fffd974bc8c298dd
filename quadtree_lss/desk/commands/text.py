# SPDX-License-Identifier: Apache-2.0
"""Text fitted to the width of the terminal."""

from __future__ import annotations

import re
import shutil
import sys
import textwrap
from collections.abc import Sequence

WIDE = 1000
"""Width of what is no terminal."""


def width() -> int:
    """Columns of the terminal; what goes into a file or another program is not folded."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else WIDE


def fold(text: str, columns: int) -> str:
    """Long lines folded: first where cells of a table end, which are two blanks apart."""
    lines = []
    for line in text.splitlines():
        if len(line) <= columns:
            lines.append(line)
            continue
        indent = line[: len(line) - len(line.lstrip())]
        row = ""
        for cell in re.split(r" {2,}", line.strip()):
            joined = f"{row}  {cell}" if row else indent + cell
            if len(joined) <= columns or not row:
                row = joined
            else:
                lines += _wrapped(row, columns, indent)
                row = f"{indent}    {cell}"
        lines += _wrapped(row, columns, indent)
    return "\n".join(lines)


def table(header: Sequence[str], rows: Sequence[Sequence[str]], columns: int) -> str:
    """Cells right-aligned below their header; where that is too wide, each row as a paragraph."""
    widths = [max(map(len, cells)) for cells in zip(header, *rows, strict=True)]
    if sum(widths) + 2 * len(widths) - 2 <= columns:
        lines = (header, *rows)
        return "\n".join(
            "  ".join(f"{c:>{w}}" for c, w in zip(line, widths, strict=True)) for line in lines
        )
    blocks = []
    for row in rows:
        cells = [f"{name} {cell}" for name, cell in zip(header, row, strict=True) if cell]
        line = ", ".join(cell.replace(" ", "\N{NO-BREAK SPACE}") for cell in cells)
        blocks.append("\n".join(_wrapped(line, columns, "")))
    return "\n".join(blocks).replace("\N{NO-BREAK SPACE}", " ")


def _wrapped(line: str, columns: int, indent: str) -> list[str]:
    return textwrap.wrap(
        line,
        max(columns, 20),
        subsequent_indent=f"{indent}    ",
        break_long_words=False,
        break_on_hyphens=False,
        drop_whitespace=True,
    ) or [""]
