# SPDX-License-Identifier: Apache-2.0
"""Command line ``quadtree-lss``: a shell around functions that can be imported as well.

Exit codes: 0 done, 1 error, 2 usage, 3 done in part (damaged input), 130 interrupted.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import quadtree_lss
from quadtree_lss.commands import config, info, replay
from quadtree_lss.commands.common import DONE, ERROR, EXIT_CODES, IN_PART, INTERRUPTED, USAGE
from quadtree_lss.commands.common import add_command as _command
from quadtree_lss.commands.common import add_config_options as _add_config_options
from quadtree_lss.commands.common import chosen_config as _config
from quadtree_lss.console import ProgressBar, first_line, quiet, say
from quadtree_lss.errors import QuadtreeLssError

SIMULATE_EXAMPLES = """examples:
  quadtree-lss simulate morpheus --seed 7 --out flight/bag      (flight/truth.npz beside it)
  quadtree-lss simulate parabola --seed 1 --out parabola/bag
  quadtree-lss simulate descent --terrain dem.npz --out descent/bag
  quadtree-lss simulate morpheus --flights 2 --outliers 0.02 --dropouts 0.05 --out two/bag
"""
EVALUATE_EXAMPLES = """examples:
  quadtree-lss evaluate results --truth flight/truth.npz
  quadtree-lss evaluate results --truth flight/truth.npz --bag flight/bag    (Table 2 as well)
  quadtree-lss evaluate ff13 ff14 both --truth two/truth.npz --out compared
  quadtree-lss evaluate --seeds 101-120 --scenario morpheus --config morpheus --out many
  quadtree-lss evaluate --seeds 1,2,7 --config morpheus --set lss.assessment=paper \\
      --bags many/flights --out paper_rules                    (flies nothing again)
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; the answer is the exit code."""
    arguments = without_ros_arguments(sys.argv[1:] if argv is None else argv)
    options = argparse.Namespace()
    try:
        options = _parser().parse_args(arguments)
        run: Callable[[argparse.Namespace], int] = options.run
        with quiet(getattr(options, "quiet", False) and not getattr(options, "json", False)):
            code = run(options)
            sys.stdout.flush()
        return code
    except SystemExit as stop:  # argparse: help, version, wrong usage
        return stop.code if isinstance(stop.code, int) else USAGE
    except QuadtreeLssError as error:
        say(f"error: {error}")
        return ERROR
    except BrokenPipeError:  # the reader of our output has gone, as with `| head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except (OSError, MemoryError) as error:
        say(f"error: {first_line(error)}")
        return ERROR
    except KeyboardInterrupt:
        say("interrupted")
        return INTERRUPTED
    except Exception as error:
        if getattr(options, "verbose", False):
            raise
        say(f"internal error: {type(error).__name__}: {first_line(error)} (-v shows where)")
        return ERROR


def main_replay_bag() -> int:
    """``ros2 run quadtree_lss replay_bag``."""
    return main(["replay", *sys.argv[1:]])


def main_simulate() -> int:
    """``ros2 run quadtree_lss simulate``."""
    return main(["simulate", *sys.argv[1:]])


def main_evaluate() -> int:
    """``ros2 run quadtree_lss evaluate``."""
    return main(["evaluate", *sys.argv[1:]])


def without_ros_arguments(arguments: Sequence[str]) -> list[str]:
    """Arguments without ``--ros-args … [--]``, which launch files add for nodes."""
    kept, ours = [], True
    for argument in arguments:
        if argument == "--ros-args":
            ours = False
        elif ours:
            kept.append(argument)
        elif argument == "--":
            ours = True
    return kept


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="quadtree-lss",
        description="Terrain map of planar elements and ranked landing sites from a flash lidar.",
        epilog=EXIT_CODES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    version = f"quadtree_lss {quadtree_lss.__version__}"
    parser.add_argument("--version", action="version", version=version)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    replay.add(commands)
    info.add(commands)
    config.add(commands)
    _add_simulate(commands)
    _add_evaluate(commands)
    return parser


def _add_simulate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "Simulate a flight: a bag, and truth.npz beside it."
    parser = _command(commands, "simulate", _simulate, text, SIMULATE_EXAMPLES)
    add = parser.add_argument
    add("scenario", choices=("morpheus", "parabola", "descent"), help="which flight")
    add("--seed", type=int, default=1, metavar="N", help="of terrain and noise (default 1)")
    add("--out", required=True, type=Path, metavar="BAG", help="bag to write")
    _add_flight_options(parser)
    add("--overwrite", action="store_true", help="replace an existing bag")
    add("-v", "--verbose", action="store_true", help="progress bar even if this is no terminal")


def _add_flight_options(parser: argparse._ActionsContainer) -> None:
    add = parser.add_argument
    add("--duration", type=float, metavar="D", help="seconds of flight")
    add("--terrain", type=Path, metavar="DEM", help=".npz with x, y, elevation (ny, nx), m")
    add("--range-noise", type=float, metavar="M", help="one sigma of a range, m")
    add("--outliers", type=float, default=0.0, metavar="F", help="share of false returns")
    add("--dropouts", type=float, default=0.0, metavar="F", help="share of missing returns")
    add(
        "--flights",
        type=int,
        default=1,
        metavar="N",
        help="fly N times over the same ground, with other navigation errors, into one bag",
    )


def _simulate(options: argparse.Namespace) -> int:
    from quadtree_lss.simulation.simulate import simulate

    with ProgressBar("simulate", "scan", options.verbose) as bar:
        result = simulate(
            options.scenario,
            options.out,
            seed=options.seed,
            duration=options.duration,
            terrain=options.terrain,
            range_noise=options.range_noise,
            outliers=options.outliers,
            dropouts=options.dropouts,
            flights=options.flights,
            overwrite=options.overwrite,
            progress=bar.update,
        )
    print(result.table())
    return DONE


def _add_evaluate(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "Score results of a replay against the truth of a simulation, or many seeds at once."
    parser = _command(commands, "evaluate", _evaluate, text, EVALUATE_EXAMPLES)
    add = parser.add_argument
    add("results", type=Path, metavar="DIR", nargs="*", help="folder that replay wrote, or several")
    add("--truth", type=Path, metavar="NPZ", help="truth.npz of the simulation")
    add("--bag", metavar="BAG", help="the bag that was replayed: also consistency (Table 2)")
    add("--out", type=Path, metavar="DIR", help="folder for tables and figures")
    many = parser.add_argument_group("many seeds at once: simulate, replay, evaluate each")
    add = many.add_argument
    add("--seeds", metavar="LIST", help="for instance 101-120 or 1,2,7")
    add("--scenario", choices=("morpheus", "parabola", "descent"), default="morpheus")
    _add_config_options(many)
    add("--bags", type=Path, metavar="DIR", help="simulated flights, kept (default OUT/flights)")
    add("--jobs", type=int, choices=(1, 2), default=2, help="processes (default 2)")
    add("--figures", action="store_true", help="draw the figures of every seed")
    _add_flight_options(many)
    add("-v", "--verbose", action="store_true", help="progress bar even if this is no terminal")


def _evaluate(options: argparse.Namespace) -> int:
    if options.seeds is not None:
        return _evaluate_seeds(options)
    if not options.results or options.truth is None:
        options.parser.error("either DIR and --truth, or --seeds and --out, are required")
    if len(options.results) > 1:
        from quadtree_lss.evaluation.compare import compare

        if options.bag is not None:
            options.parser.error("--bag goes with one DIR only")
        compared = compare(options.results, options.truth, options.out)
        print(compared.table())
        print(f"figures and numbers in {compared.out}")
        return DONE
    from quadtree_lss.evaluation.evaluate import evaluate

    result = evaluate(options.results[0], options.truth, options.out, bag=options.bag)
    print(result.table())
    print(f"figures and numbers in {result.out}")
    return DONE


def _evaluate_seeds(options: argparse.Namespace) -> int:
    from quadtree_lss.evaluation.seeds import FlightOptions, evaluate_seeds, parse_seeds

    if options.results or options.truth is not None or options.bag is not None:
        options.parser.error("--seeds makes its own flights: leave out DIR, --truth and --bag")
    if options.out is None:
        options.parser.error("the following arguments are required: --out")
    flight = FlightOptions(
        scenario=options.scenario,
        duration=options.duration,
        terrain=None if options.terrain is None else str(options.terrain),
        range_noise=options.range_noise,
        outliers=options.outliers,
        dropouts=options.dropouts,
        flights=options.flights,
    )
    with ProgressBar("evaluate", "step", options.verbose) as bar:
        result = evaluate_seeds(
            parse_seeds(options.seeds),
            options.out,
            _config(options),
            flight,
            bags=options.bags,
            jobs=options.jobs,
            figures=options.figures,
            progress=bar.update,
        )
    print(result.table())
    print(f"figures and numbers in {result.out}")
    return IN_PART if result.failed else DONE


if __name__ == "__main__":
    sys.exit(main())
