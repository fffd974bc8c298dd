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

import yaml

import quadtree_lss
from quadtree_lss.configuration import dump_config, load_config
from quadtree_lss.console import ProgressBar, first_line, print_result, say, wants_progress
from quadtree_lss.core.config import Config
from quadtree_lss.errors import QuadtreeLssError

DONE, ERROR, USAGE, IN_PART, INTERRUPTED = 0, 1, 2, 3, 130

REPLAY_EXAMPLES = """examples:
  quadtree-lss replay flight_bag --out results --config morpheus
  quadtree-lss replay flight.mcap --out results --config morpheus --config my_lander.yaml
  quadtree-lss replay flight_bag --out results --start 5 --duration 10 --no-report
  quadtree-lss replay flight_bag --publish --rate 0.5     (into running nodes; needs ROS 2)
"""
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
CONFIG_EXAMPLES = """examples:
  quadtree-lss config > my_lander.yaml                  (every parameter, explained)
  quadtree-lss config --config morpheus --set lss.margin=1.0
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs one command; the answer is the exit code."""
    arguments = without_ros_arguments(sys.argv[1:] if argv is None else argv)
    options = argparse.Namespace()
    try:
        options = _parser().parse_args(arguments)
        run: Callable[[argparse.Namespace], int] = options.run
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
    )
    version = f"quadtree_lss {quadtree_lss.__version__}"
    parser.add_argument("--version", action="version", version=version)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_replay(commands)
    _add_simulate(commands)
    _add_evaluate(commands)
    _add_config(commands)
    return parser


def _command(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    run: Callable[[argparse.Namespace], int],
    text: str,
    examples: str,
) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name,
        help=text,
        description=text,
        epilog=examples,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run, parser=parser)
    return parser


def _add_config_options(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--config",
        action="append",
        default=[],
        metavar="YAML",
        help="ROS parameter file or shipped configuration (default, morpheus, parabola, …);"
        " several overlay each other, the later wins",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="set one parameter, for instance lss.margin=1.0; wins over every file",
    )


def _add_replay(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "Map a recorded bag and rank landing sites, offline and deterministically."
    parser = _command(commands, "replay", _replay, text, REPLAY_EXAMPLES)
    add = parser.add_argument
    add("bag", metavar="BAG", help="rosbag2 directory, .mcap, .db3 or ROS 1 .bag")
    add("--out", metavar="DIR", type=Path, help="folder for the results; may exist")
    _add_config_options(parser)
    add("--scan-topic", metavar="T", help="point clouds (default /lidar/points, else by type)")
    add("--pose-topic", metavar="T", help="poses (default /nav/pose, else by type)")
    add("--start", metavar="S", type=float, default=0.0, help="begin S seconds into the bag")
    add("--duration", metavar="D", type=float, help="process D seconds only")
    add("--no-report", action="store_true", help="no figures and no report.html")
    add("--publish", action="store_true", help="play into running nodes, with /clock (needs ROS 2)")
    add("--rate", metavar="R", type=float, default=1.0, help="speed of --publish (default 1)")
    add("-v", "--verbose", action="store_true", help="progress bar even if this is no terminal")


def _replay(options: argparse.Namespace) -> int:
    if options.publish:
        return _publish(options)
    if options.out is None:
        options.parser.error("the following arguments are required: --out")
    from quadtree_lss.replay.replay import replay

    config = _config(options)
    with ProgressBar("replay", "s", options.verbose) as bar:
        result = replay(
            options.bag,
            options.out,
            config,
            scan_topic=options.scan_topic,
            pose_topic=options.pose_topic,
            start=options.start,
            duration=options.duration,
            report=not options.no_report,
            progress=bar.update,
        )
    for line in result.warnings:
        say(f"warning: {line}")
    print_result(result)
    if result.losses:
        for line in result.losses:
            say(f"damaged: {line}")
        say("the bag is damaged: everything readable was processed")
        return IN_PART
    return DONE


def _publish(options: argparse.Namespace) -> int:
    try:
        from quadtree_lss.ros.player import play
    except ImportError as error:
        msg = f"--publish needs ROS 2 (rclpy), which cannot be imported: {first_line(error)}"
        raise QuadtreeLssError(msg) from None
    report = play(
        options.bag,
        rate=options.rate,
        scan_topic=options.scan_topic,
        pose_topic=options.pose_topic,
        start=options.start,
        duration=options.duration,
        progress=wants_progress(options.verbose),
    )
    print(f"{report.scans} scans and {report.poses} poses sent in {report.duration:.1f} s")
    for line in report.losses:
        say(f"damaged: {line}")
    return IN_PART if report.losses else DONE


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


def _add_config(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    text = "Print a configuration as a ROS parameter file, each key explained."
    parser = _command(commands, "config", _print_config, text, CONFIG_EXAMPLES)
    _add_config_options(parser)
    parser.add_argument("--plain", action="store_true", help="without the explanations")


def _print_config(options: argparse.Namespace) -> int:
    print(dump_config(_config(options), comments=not options.plain), end="")
    return DONE


def _config(options: argparse.Namespace) -> Config:
    overrides: dict[str, object] = {}
    for item in options.set:
        key, equals, value = item.partition("=")
        if not equals:
            options.parser.error(f"--set {item}: expected KEY=VALUE")
        try:
            overrides[key.strip()] = yaml.safe_load(value)
        except yaml.YAMLError:
            options.parser.error(f"--set {item}: not a value")
    return load_config(options.config, overrides)


if __name__ == "__main__":
    sys.exit(main())
