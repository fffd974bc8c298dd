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
    parser = add_command(commands, "evaluate", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    text = "folder that replay wrote, or several"
    add("results", type=named, metavar="DIR", nargs="*", help=text)
    add("--truth", type=named, metavar="NPZ", help="truth.npz of the simulation")
    text = "the bag that was replayed, for Table 2 (default: where it was when it was replayed)"
    add("--bag", type=named, metavar="BAG", help=text)
    text = "folder for tables and figures (default DIR/evaluation; of several results/<time>)"
    add("--out", type=named, metavar="DIR", help=text)


def _run(options: argparse.Namespace) -> int:
    if not options.results or options.truth is None:
        options.parser.error("DIR and --truth are required")
    from quadtree_lss.lab.evaluation.evaluate import ComparisonResult, compare, evaluate
    from quadtree_lss.lab.evaluation.scores import EvaluationResult

    result: EvaluationResult | ComparisonResult
    with ProgressBar("consistency", "scans", options.verbose) as bar:
        how = {"bag": options.bag, "progress": bar.update}
        if len(options.results) == 1:
            result = evaluate(options.results[0], options.truth, options.out, **how)
        elif options.bag is not None:
            options.parser.error("--bag goes with one DIR only")
        else:
            result = compare(options.results, options.truth, options.out, progress=bar.update)
    tell(options, result, f"figures and numbers in {result.out}")
    return DONE
