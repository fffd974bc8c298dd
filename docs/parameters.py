# SPDX-License-Identifier: Apache-2.0
"""The page of the parameters: `python docs/parameters.py > docs/parameters.md`."""

import sys
from collections.abc import Iterator
from itertools import groupby

from quadtree_lss.onboard.config.settings import Parameter, parameters

INTRODUCTION = """\
# Parameters

<!-- From onboard/config/sections.py by: python docs/parameters.py > docs/parameters.md -->

A parameter file needs [`vehicle`](#vehicle), [`domain`](#domain) and [`lidar`](#lidar);
`quadtree-lss config suggest` writes these sections from a bag. The other defaults suit most
vehicles, because most lengths follow from the vehicle: `quadtree-lss config explain vehicle` prints
them.

One file serves all nodes and `quadtree-lss replay`. You can set parameters marked *live* while a
node runs (`ros2 param set`); the others are read-only after the start.
"""


def parameter_table() -> str:
    """Return the page."""
    parts = [INTRODUCTION]
    for section, rows in groupby(parameters(), key=lambda row: row.name.partition(".")[0]):
        parts.append("\n".join([f"\n## {section}\n", *_table(rows)]) + "\n")
    return "".join(parts)


def _table(rows: Iterator[Parameter]) -> Iterator[str]:
    yield "| Parameter | Default | Range | Meaning |"
    yield "| --- | --- | --- | --- |"
    for row in rows:
        live = "*live*: " if row.live else ""
        default = f"{_default(row)} {row.unit}".strip()
        yield f"| `{row.name}` | {default} | {_range(row)} | {live}{row.doc} |"


def _range(row: Parameter) -> str:
    if row.choices:
        return ", ".join(f"`{choice}`" for choice in row.choices)
    return f"{row.low:g}…{row.high:g}" if row.type in (int, float) else ""


def _default(row: Parameter) -> str:
    if row.type is str:
        return f"`{row.default}`" if row.default else "empty"
    return str(row.default).lower() if row.type is bool else f"{row.default:g}"


if __name__ == "__main__":
    sys.stdout.write(parameter_table())
