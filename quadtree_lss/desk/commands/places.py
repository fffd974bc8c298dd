# SPDX-License-Identifier: Apache-2.0
"""Polygons and places on the command line.

A value is a tuple of one, so that ``none``, which lifts what a bag says, differs from no option.
"""

from __future__ import annotations

import argparse
import math
from typing import Any


def add_landing_options(parser: argparse._ActionsContainer, default: str) -> None:
    """``--area``, ``--keep-out`` and ``--target``; ``default`` says what holds without them."""
    for name, what in (("area", "land inside"), ("keep-out", "never land in")):
        text = f"{what} this polygon, map frame, m{default}"
        parser.add_argument(f"--{name}", metavar="'X,Y X,Y X,Y ...'", type=polygon, help=text)
    text = "land near this place, or none; as --area" if default else "land near this place"
    parser.add_argument("--target", metavar="X,Y", type=place, help=text)


def landing_of(options: argparse.Namespace) -> dict[str, Any]:
    """What the options say of landing, by name."""
    given = {"area": options.area, "keep_out": options.keep_out, "target": options.target}
    return {name: value[0] for name, value in given.items() if value is not None}


def polygon(text: str) -> tuple[list[list[float]] | None]:
    """``'0,0 9,0 9,9'``, or ``none``."""
    corners = _numbers(text)
    if corners is not None and len(corners) < 3:
        msg = f"'{text}' has {len(corners)} corners; a polygon has three or more"
        raise argparse.ArgumentTypeError(msg)
    return (corners,)


def place(text: str) -> tuple[list[float] | None]:
    """``3,-4``, or ``none``."""
    corners = _numbers(text)
    if corners is not None and len(corners) != 1:
        msg = f"'{text}' is not a place X,Y"
        raise argparse.ArgumentTypeError(msg)
    return (None if corners is None else corners[0],)


def _numbers(text: str) -> list[list[float]] | None:
    if text.strip() == "none":
        return None
    try:
        corners = [[float(v) for v in pair.split(",")] for pair in text.split()]
    except ValueError:
        corners = []
    good = all(len(pair) == 2 and all(map(math.isfinite, pair)) for pair in corners)
    if not corners or not good:
        msg = f"'{text}' does not consist of pairs X,Y of numbers in m, apart by blanks"
        raise argparse.ArgumentTypeError(msg)
    return corners
