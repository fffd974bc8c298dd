# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss evaluate``: one run or several against the truth."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from quadtree_lss.desk.commands.common import DONE, add_command, add_json, named, print_json
from quadtree_lss.desk.commands.console import ProgressBar, show

if TYPE_CHECKING:
    from quadtree_lss.lab.evaluation import ComparisonResult, EvaluationResult

TEXT = "Score results of a replay against the truth of a simulation."
EXAMPLES = """examples:
  quadtree-lss evaluate results/latest --truth flight/truth.npz
  quadtree-lss evaluate results/latest --truth flight/truth.npz --bag moved/bag    (for Table 2)
  quadtree-lss evaluate ff13 ff14 both --truth two/truth.npz --out compared

Many flights at once: quadtree-lss campaign.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the subcommand."""
    parser = add_command(commands, "evaluate", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    add(
        "results", type=named, metavar="DIR", nargs="*", help="folder that replay wrote, or several"
    )
    add("--truth", type=named, metavar="NPZ", help="truth.npz of the simulation")
    text = "the bag that was replayed, for Table 2 (default: where it was when it was replayed)"
    add("--bag", type=named, metavar="BAG", help=text)
    text = "folder for tables and figures (default DIR/evaluation; of several results/<time>)"
    add("--out", type=named, metavar="DIR", help=text)
    add("--seeds", help=argparse.SUPPRESS)  # of an earlier version
    add_json(parser)


def _run(options: argparse.Namespace) -> int:
    if options.seeds is not None:
        options.parser.error(
            "many seeds are a study now: quadtree-lss campaign STUDY.yaml --out DIR"
        )
    if not options.results or options.truth is None:
        options.parser.error("DIR and --truth are required")
    if len(options.results) > 1:
        from quadtree_lss.lab.evaluation.evaluate import compare

        if options.bag is not None:
            options.parser.error("--bag goes with one DIR only")
        with ProgressBar("consistency", "scans", options.verbose) as bar:
            several = compare(options.results, options.truth, options.out, progress=bar.update)
        _show(options, several)
        return DONE
    from quadtree_lss.lab.evaluation.evaluate import evaluate

    with ProgressBar("consistency", "scans", options.verbose) as bar:
        result = evaluate(
            options.results[0], options.truth, options.out, bag=options.bag, progress=bar.update
        )
    _show(options, result)
    return DONE


def _show(options: argparse.Namespace, result: EvaluationResult | ComparisonResult) -> None:
    if options.json:
        print_json({"out": str(result.out), **result.as_dict()})
    else:
        show(result.table())
        print(f"figures and numbers in {result.out}")
