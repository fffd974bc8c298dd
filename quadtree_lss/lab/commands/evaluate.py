# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss evaluate``: one run or several against the truth."""

from __future__ import annotations

import argparse

from quadtree_lss.desk.commands.common import DONE, add_command, named, tell
from quadtree_lss.desk.commands.console import ProgressBar

TEXT = "Score results of a replay against the truth of a simulation."
EXAMPLES = """examples:
  quadtree-lss evaluate results/latest --truth flight/truth.npz
  quadtree-lss evaluate results/latest --truth flight/truth.npz --bag moved/bag    (for Table 2)
  quadtree-lss evaluate ff13 ff14 both --truth two/truth.npz --out compared

Many flights at once: quadtree-lss campaign.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    add = add_command(commands, "evaluate", _run, TEXT, EXAMPLES).add_argument
    text = "folder that replay wrote, or several"
    add("results", type=named, metavar="DIR", nargs="+", help=text)
    text = "truth.npz of the simulation"
    add("--truth", required=True, type=named, metavar="NPZ", help=text)
    text = "the bag that was replayed, for Table 2 (default: where it was when it was replayed)"
    add("--bag", type=named, metavar="BAG", help=text)
    text = "folder for tables and figures (default DIR/evaluation; of several results/<time>)"
    add("--out", type=named, metavar="DIR", help=text)


def _run(options: argparse.Namespace) -> int:
    from quadtree_lss.lab.evaluation.evaluate import (
        ComparisonResult,
        EvaluationResult,
        compare,
        evaluate,
    )

    first, *others = options.results
    if others and options.bag is not None:
        options.parser.error("--bag goes with one DIR only")
    result: EvaluationResult | ComparisonResult
    with ProgressBar("consistency", "scans", options.verbose) as bar:
        how = {"out": options.out, "progress": bar.update}
        if others:
            result = compare(options.results, options.truth, **how)
        else:
            result = evaluate(first, options.truth, bag=options.bag, **how)
    tell(options, result, f"figures and numbers in {result.out}")
    return DONE
