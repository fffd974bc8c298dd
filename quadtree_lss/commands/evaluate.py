# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss evaluate``: one run, several runs, or many seeds against the truth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from quadtree_lss.commands.common import (
    DONE,
    IN_PART,
    INTERRUPTED,
    add_command,
    add_config_options,
    add_json,
    chosen_config,
    print_json,
)
from quadtree_lss.commands.simulate import SCENARIOS, add_flight_options
from quadtree_lss.console import Interruption, ProgressBar, say, warn

if TYPE_CHECKING:
    from quadtree_lss.evaluation import ComparisonResult, EvaluationResult, SeedsResult

TEXT = "Score results of a replay against the truth of a simulation, or many seeds at once."
EXAMPLES = """examples:
  quadtree-lss evaluate results/latest --truth flight/truth.npz
  quadtree-lss evaluate results/latest --truth flight/truth.npz --bag flight/bag   (Table 2 too)
  quadtree-lss evaluate ff13 ff14 both --truth two/truth.npz --out compared
  quadtree-lss evaluate --seeds 101-120 --scenario morpheus --config morpheus --out many
  quadtree-lss evaluate --seeds 1,2,7 --config morpheus --set lss.assessment=paper \\
      --bags many/flights --out paper_rules                    (flies nothing again)

Exit code 3 if some seeds could not be scored. Ctrl-C ends --seeds there: the tables are those
of the seeds scored so far. Once more stops at once.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Declares the subcommand."""
    parser = add_command(commands, "evaluate", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    add("results", type=Path, metavar="DIR", nargs="*", help="folder that replay wrote, or several")
    add("--truth", type=Path, metavar="NPZ", help="truth.npz of the simulation")
    add("--bag", metavar="BAG", help="the bag that was replayed: also consistency (Table 2)")
    text = "folder for tables and figures (default DIR/evaluation; of seeds results/<time>)"
    add("--out", type=Path, metavar="DIR", help=text)
    many = parser.add_argument_group("many seeds at once: simulate, replay, evaluate each")
    add = many.add_argument
    add("--seeds", metavar="LIST", help="for instance 101-120 or 1,2,7")
    add("--scenario", choices=SCENARIOS, default="morpheus", help="(default morpheus)")
    add_config_options(many)
    add("--bags", type=Path, metavar="DIR", help="simulated flights, kept (default OUT/flights)")
    add("--jobs", type=int, choices=(1, 2), default=2, help="processes (default 2)")
    add("--figures", action="store_true", help="draw the figures of every seed")
    add_flight_options(many)
    add_json(parser)


def _run(options: argparse.Namespace) -> int:
    if options.seeds is not None:
        return _seeds(options)
    if not options.results or options.truth is None:
        options.parser.error("either DIR and --truth, or --seeds, are required")
    if len(options.results) > 1:
        from quadtree_lss.evaluation.compare import compare

        if options.bag is not None:
            options.parser.error("--bag goes with one DIR only")
        _show(options, compare(options.results, options.truth, options.out))
        return DONE
    from quadtree_lss.evaluation.evaluate import evaluate

    _show(options, evaluate(options.results[0], options.truth, options.out, bag=options.bag))
    return DONE


def _show(
    options: argparse.Namespace, result: EvaluationResult | ComparisonResult | SeedsResult
) -> None:
    if options.json:
        print_json({"out": str(result.out), **result.as_dict()})
    else:
        print(result.table())
        print(f"figures and numbers in {result.out}")


def _seeds(options: argparse.Namespace) -> int:
    from quadtree_lss.evaluation.seeds import FlightOptions, evaluate_seeds, parse_seeds
    from quadtree_lss.replay.results import link_latest, new_folder

    if options.results or options.truth is not None or options.bag is not None:
        options.parser.error("--seeds makes its own flights: leave out DIR, --truth and --bag")
    seeds, config = parse_seeds(options.seeds), chosen_config(options)
    out = options.out if options.out is not None else new_folder(Path("results"))
    flight = FlightOptions(
        scenario=options.scenario,
        duration=options.duration,
        terrain=None if options.terrain is None else str(options.terrain),
        range_noise=options.range_noise,
        outliers=options.outliers,
        dropouts=options.dropouts,
        flights=options.flights,
    )
    with Interruption() as interruption, ProgressBar("evaluate", "step", options.verbose) as bar:
        result = evaluate_seeds(
            seeds,
            out,
            config,
            flight,
            bags=options.bags,
            jobs=options.jobs,
            figures=options.figures,
            progress=bar.update,
            stop=interruption.asked,
        )
    if options.out is None:
        link_latest(out)
    _show(options, result)
    if result.interrupted:
        say(f"interrupted: results are of {len(result.scored)} of {len(seeds)} seeds")
        return INTERRUPTED
    if result.failed:
        warn(f"{len(result.failed)} of {len(seeds)} seeds could not be scored")
        return IN_PART
    return DONE
