# SPDX-License-Identifier: Apache-2.0
"""Writes ``docs/parameters.md``: ``python -m quadtree_lss.onboard.config.documentation``."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from itertools import groupby

from quadtree_lss.onboard.config.settings import Parameter, parameters

INTRODUCTION = """\
# Parameters

Written by `python -m quadtree_lss.onboard.config.documentation > docs/parameters.md` from the table
in `onboard/config/sections.py`, which also declares and documents them; the
module `settings` beside it checks them.

Both nodes accept all of them, so one parameter file serves both, and `quadtree-lss replay` as
well. *Live* ones can be set while a node runs (`ros2 param set`); the others are read-only after
the start. Lengths are m, and a name that ends in `_deg` is in degrees.
"""


def parameter_table() -> str:
    """The whole document."""
    parts = [INTRODUCTION]
    for section, rows in groupby(parameters(), key=lambda row: row.name.partition(".")[0]):
        parts.append("\n".join([f"\n## {section}\n", *_table(rows)]) + "\n")
    return "".join(parts)


def _table(rows: Iterator[Parameter]) -> Iterator[str]:
    yield "| Parameter | Type | Unit | Range | Default | Live | Meaning |"
    yield "| --- | --- | --- | --- | --- | --- | --- |"
    for row in rows:
        live = "yes" if row.live else ""
        cells = (f"`{row.name}`", row.type.__name__, row.unit, _range(row), _default(row), live)
        yield f"| {' | '.join((*cells, row.doc))} |"


def _range(row: Parameter) -> str:
    if row.choices:
        return ", ".join(f"`{choice}`" for choice in row.choices)
    return f"{row.low:g} … {row.high:g}" if row.type in (int, float) else ""


def _default(row: Parameter) -> str:
    if row.type is str:
        return f"`{row.default}`" if row.default else "empty"
    return str(row.default).lower() if row.type is bool else f"{row.default}"


if __name__ == "__main__":
    sys.stdout.write(parameter_table())
