# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss compare``: two results without truth."""

from __future__ import annotations

import argparse

from quadtree_lss.desk.commands.common import DONE, ERROR, add_command, named, tell
from quadtree_lss.desk.commands.console import say

TEXT = "Compare two results of the same ground: heights, safe ground, sites gained and lost."
EXAMPLES = """examples:
  quadtree-lss compare results/2026-11-20_10-00-00 results/latest
  quadtree-lss compare before after --out difference        (also as JSON and picture)
  quadtree-lss compare before after --json

Compared at the grid points of A. Exit code 1 if they are not of the same ground.
Against the truth of a simulation: quadtree-lss evaluate A B --truth truth.npz
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = add_command(commands, "compare", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    add("first", type=named, metavar="A", help="folder that replay or sites wrote")
    add("second", type=named, metavar="B", help="another one of the same ground")
    text = "folder for comparison.json and comparison.png (default: none is written)"
    add("--out", metavar="DIR", type=named, help=text)


def _run(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.differences import compare_results

    result = compare_results(options.first, options.second, options.out)
    written = f"comparison.json and comparison.png in {options.out}"
    tell(options, result, *[written] * (options.out is not None))
    if not result.same_ground:
        text = f"correlation {result.heights.correlation:.2f}, RMS {result.heights.rms:.2f} m"
        say(f"not of the same ground, or not at the same place: their heights differ: {text}")
        return ERROR
    return DONE
