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
    named,
    print_json,
)
from quadtree_lss.commands.console import Interruption, ProgressBar, say, show, warn
from quadtree_lss.commands.simulate import SCENARIOS, add_flight_options

if TYPE_CHECKING:
    from quadtree_lss.campaign import SeedsResult
    from quadtree_lss.evaluation import ComparisonResult, EvaluationResult

TEXT = "Score results of a replay against the truth of a simulation, or many seeds at once."
EXAMPLES = """examples:
  quadtree-lss evaluate results/latest --truth flight/truth.npz
  quadtree-lss evaluate results/latest --truth flight/truth.npz --bag moved/bag    (for Table 2)
  quadtree-lss evaluate ff13 ff14 both --truth two/truth.npz --out compared
  quadtree-lss evaluate --seeds 101-120 --scenario morpheus --config morpheus --out many
  quadtree-lss evaluate --seeds 1,2,7 --config morpheus --set lss.assessment=paper \\
      --bags many/flights --out paper_rules                    (flies nothing again)

Exit code 3 if some seeds could not be scored. Ctrl-C ends --seeds there: the tables are those
of the seeds scored so far. A second one stops at once.
"""

_FLIGHT = (
    "scenario",
    "duration",
    "terrain",
    "range_noise",
    "outliers",
    "dropouts",
    "flights",
)
"""Options that are those of `FlightOptions`."""

_OF_SEEDS = (*_FLIGHT, "config", "set", "bags", "jobs", "figures")
"""Options that mean nothing without ``--seeds``."""


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
    text = "folder for tables and figures (default DIR/evaluation; else results/<time>)"
    add("--out", type=named, metavar="DIR", help=text)
    many = parser.add_argument_group("many seeds at once: simulate, replay, evaluate each")
    add = many.add_argument
    add("--seeds", metavar="LIST", help="for instance 101-120 or 1,2,7")
    add("--scenario", choices=SCENARIOS, help="(default morpheus)")
    add_config_options(many)
    add("--bags", type=named, metavar="DIR", help="simulated flights, kept (default OUT/flights)")
    add("--jobs", type=int, choices=(1, 2), help="processes (default 2)")
    add("--figures", action="store_true", help="draw the figures of every seed")
    add_flight_options(many)
    parser.set_defaults(**dict.fromkeys(_FLIGHT))  # None: left to FlightOptions
    add_json(parser)


def _run(options: argparse.Namespace) -> int:
    if options.seeds is not None:
        return _seeds(options)
    if not options.results or options.truth is None:
        options.parser.error("either DIR and --truth, or --seeds, are required")
    given = [_flag(name) for name in _OF_SEEDS if _is_given(getattr(options, name))]
    if given:
        options.parser.error(f"only with --seeds, not with DIR: {', '.join(given)}")
    if len(options.results) > 1:
        from quadtree_lss.evaluation.compare import compare

        if options.bag is not None:
            options.parser.error("--bag goes with one DIR only")
        with ProgressBar("consistency", "scans", options.verbose) as bar:
            several = compare(options.results, options.truth, options.out, progress=bar.update)
        _show(options, several)
        return DONE
    from quadtree_lss.evaluation.evaluate import evaluate

    with ProgressBar("consistency", "scans", options.verbose) as bar:
        result = evaluate(
            options.results[0],
            options.truth,
            options.out,
            bag=options.bag,
            progress=bar.update,
        )
    _show(options, result)
    return DONE


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _is_given(value: object) -> bool:
    return not (value is None or value is False or value == [])


def _show(
    options: argparse.Namespace, result: EvaluationResult | ComparisonResult | SeedsResult
) -> None:
    if options.json:
        print_json({"out": str(result.out), **result.as_dict()})
    else:
        show(result.table())
        print(f"figures and numbers in {result.out}")


def _seeds(options: argparse.Namespace) -> int:
    from quadtree_lss.campaign.seeds import FlightOptions, evaluate_seeds, parse_seeds
    from quadtree_lss.evaluation.results import EvaluationError
    from quadtree_lss.replay.results import new_folder

    if options.results or options.truth is not None or options.bag is not None:
        options.parser.error("--seeds makes its own flights: leave out DIR, --truth and --bag")
    try:
        seeds = parse_seeds(options.seeds)
    except EvaluationError as error:
        options.parser.error(f"--{error}")
    config = chosen_config(options)
    out = options.out if options.out is not None else new_folder(Path("results"))
    chosen = {name: getattr(options, name) for name in _FLIGHT}
    chosen["terrain"] = None if options.terrain is None else str(options.terrain)
    flight = FlightOptions(**{name: value for name, value in chosen.items() if value is not None})
    then = f"writes the tables of the seeds scored so far into {out}"
    verbose = options.verbose
    with Interruption(then) as interruption, ProgressBar("evaluate", "steps", verbose) as bar:
        result = evaluate_seeds(
            seeds,
            out,
            config,
            flight,
            bags=options.bags,
            jobs=options.jobs or 2,
            figures=options.figures,
            progress=bar.update,
            stop=interruption.asked,
        )
    _show(options, result)
    if result.interrupted:
        say(f"interrupted: results are of {len(result.scored)} of {len(seeds)} seeds")
        return INTERRUPTED
    if result.failed:
        warn(f"{len(result.failed)} of {len(seeds)} seeds could not be scored")
        return IN_PART
    return DONE
