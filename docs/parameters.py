# SPDX-License-Identifier: Apache-2.0
"""The page of the parameters: `python docs/parameters.py > docs/parameters.md`."""

import dataclasses
import sys
from collections.abc import Iterator
from itertools import groupby

from quadtree_lss.desk.commands.config import rule
from quadtree_lss.onboard.config.settings import Parameter, parameters
from quadtree_lss.onboard.config.vehicle import Lengths

INTRODUCTION = """\
# Parameters

<!-- From onboard/config/sections.py by: python docs/parameters.py > docs/parameters.md -->

To begin, a file needs [`vehicle`](#vehicle), [`domain`](#domain) and [`lidar`](#lidar), which
`quadtree-lss config suggest` writes from a bag. The other defaults hold for most, and most lengths
[follow from the vehicle](#what-follows-from-the-vehicle). `config explain` says what this page
says.

One file serves all nodes and `quadtree-lss replay`. *Live* ones can be set while a node runs
(`ros2 param set`); the others are read-only after the start. Lengths are m, and a name that ends in
`_deg` is in degrees.
"""


def parameter_table() -> str:
    parts = [INTRODUCTION]
    for section, rows in groupby(parameters(), key=lambda row: row.name.partition(".")[0]):
        parts.append("\n".join([f"\n## {section}\n", *_table(rows)]) + "\n")
    rows = (
        f"| {item.name} | {rule(item.name).replace(' x ', ' · ')} | {item.default:g}"
        f" {item.metadata['unit']} | {item.metadata['doc']} |"
        for item in dataclasses.fields(Lengths)
    )
    heads = ["\n## What follows from the vehicle\n", "| Length | Rule | By default | Meaning |"]
    return "".join(parts) + "\n".join([*heads, "| --- | --- | --- | --- |", *rows]) + "\n"


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
