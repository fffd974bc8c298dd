# SPDX-License-Identifier: Apache-2.0
"""Shared parts of the subcommands: parser, exit codes, options, configuration."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn, TypeVar

from quadtree_lss.desk.commands.console import first_line
from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.onboard.config.settings import Config, ConfigError
from quadtree_lss.onboard.config.vehicle import VehicleConfig
from quadtree_lss.onboard.config.yaml_text import YamlError, parse_yaml
from quadtree_lss.onboard.errors import QuadtreeLssError

BAG = "rosbag2 folder, .mcap, .db3 or ROS 1 .bag"
TOPICS = ("scan_topic", "pose_topic")
N = TypeVar("N", int, float)
DONE, ERROR, USAGE, IN_PART, INTERRUPTED = 0, 1, 2, 3, 130
EXIT_CODES = """exit codes:
  0 done   1 error   2 wrong usage   3 done in part (damaged input)   130 interrupted
"""


class UsageError(QuadtreeLssError):
    """The command line is wrong."""


class Parser(argparse.ArgumentParser):
    """An argument parser that accepts values that start with a minus sign."""

    def __init__(self, *args: Any, **named: Any) -> None:
        super().__init__(*args, **named)
        self._negative_number_matcher = re.compile(r"-\.?\d")

    #: Suggested command by a wrong word that users try.
    suggestions: Mapping[str, str] = MappingProxyType({})

    def error(self, message: str) -> NoReturn:
        match = re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message)
        if match:
            word, choices = match[1], re.findall(r"[\w-]+", match[2])
            near = self.suggestions.get(word) or nearest(word, choices)
            advice = f"try {near}" if near else f"choose from {match[2]}"
            message = f"there is no {word!r}; {advice}"
        raise UsageError(f"{message} ({self.prog} --help)")

    def unknown(self, words: Sequence[str]) -> NoReturn:
        """Report unknown arguments with the most similar options."""
        options = self._option_string_actions
        found = (nearest(word.partition("=")[0], options) for word in words)
        near = ", ".join(filter(None, found))
        hint = f"; the nearest is {near}" if near else ""
        self.error(f"unrecognized arguments: {' '.join(words)}{hint}")


def nearest(word: str, words: Iterable[str]) -> str:
    """Return the most similar word of ``words``; empty if none is similar."""
    return next(iter(difflib.get_close_matches(word, [*words], 1)), "")


def add_command(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
    name: str,
    run: Callable[[argparse.Namespace], int],
    text: str,
    examples: str,
) -> argparse.ArgumentParser:
    """Add a subcommand with its help and the common options."""
    style, epilog = argparse.RawDescriptionHelpFormatter, f"{examples}\n{EXIT_CODES}"
    layout: dict[str, Any] = {"formatter_class": style, "epilog": epilog}
    parser = commands.add_parser(name, help=text, description=text, **layout)
    parser.set_defaults(run=run, parser=parser)
    add = parser.add_argument
    add("-q", "--quiet", action="store_true", help="errors only: no progress, table or warnings")
    text = "progress bar even without a terminal; traceback of internal errors"
    add("-v", "--verbose", action="store_true", help=text)
    add("--json", action="store_true", help="print the result as JSON, for scripts")
    return parser


def keywords(options: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return options by name, as keyword arguments of a function."""
    return {name: getattr(options, name) for name in names}


def reject_options(options: argparse.Namespace, what: str, *names: str) -> None:
    """Report a usage error if one of these options is set, which ``what`` does not use."""
    default = options.parser.get_default
    unused = [n for n in names if n in options and getattr(options, n) != default(n)]
    listed = ", ".join(f"--{name.replace('_', '-')}" for name in unused)
    if listed:
        options.parser.error(f"{listed} {'do' if ',' in listed else 'does'} not go with {what}")


@contextlib.contextmanager
def importing_ros(what: str) -> Iterator[None]:
    """Context that reports a failed import of ROS, which ``what`` needs."""
    try:
        yield
    except ImportError as error:
        missing = (error.name or "rclpy").partition(".")[0]
        library = "ROS 2 (rclpy)" if missing == "rclpy" else missing
        msg = f"{what} needs {library}, which cannot be imported: {first_line(error)}"
        raise QuadtreeLssError(msg) from None


def path(text: str) -> Path:
    """Type of an option: a path that is not empty."""
    if not text.strip():
        raise argparse.ArgumentTypeError("the name of a file or folder is empty")
    return Path(text)


def _number(kind: Callable[[str], N], fits: Callable[[N], bool], wanted: str) -> Callable[[str], N]:
    """Return the type of an option: a number for which ``fits`` is true."""

    def convert(text: str) -> N:
        with contextlib.suppress(ValueError):
            if fits(value := kind(text)):
                return value
        raise argparse.ArgumentTypeError(f"{text!r} is not {wanted}")

    return convert


positive = _number(float, lambda value: 0.0 < value < math.inf, "a finite number greater than 0")
not_negative = _number(float, lambda value: 0.0 <= value < math.inf, "a finite number 0 or greater")
share = _number(float, lambda value: 0.0 <= value <= 1.0, "a finite number from 0 to 1")


def whole(least: int) -> Callable[[str], int]:
    """Return the type of an option: a whole number, ``least`` or greater."""
    return _number(int, lambda value: value >= least, f"a whole number of {least} or more")


def add_topics(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--scan-topic", metavar="T", help="point clouds (default /lidar/points, else by type)")
    add("--pose-topic", metavar="T", help="poses (default /nav/pose, else by type)")


def add_config_options(parser: argparse._ActionsContainer) -> None:
    add = parser.add_argument
    repeatable: dict[str, Any] = {"action": "append", "default": []}
    text = "ROS parameter file or shipped configuration (default, morpheus, parabola, …);"
    text += " later files override earlier ones"
    add("--config", metavar="YAML", help=text, **repeatable)
    text = "set one parameter, for instance lss.margin=1.0; overrides every file"
    add("--set", metavar="KEY=VALUE", help=text, **repeatable)
    text = "diameter and clearance of the vehicle, m, with pads in proportion; overrides every file"
    add("--vehicle", type=vehicle, default={}, metavar="D,C", help=text)


def overrides(options: argparse.Namespace) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for item in options.set:
        key, equals, value = item.partition("=")
        if not (equals and key.strip()):
            options.parser.error(f"--set {item}: expected KEY=VALUE")
        try:
            found[key.strip()] = parse_yaml(value)
        except YamlError as error:
            options.parser.error(f"--set {item}: not a value: {error}")
    return found


def chosen_config(options: argparse.Namespace) -> Config:
    values = options.vehicle | overrides(options)
    try:
        return load_config(options.config, values, origin="--vehicle and --set")
    except ConfigError as error:
        options.parser.error(f"{error}")


def add_landing_options(parser: argparse._ActionsContainer, default: str) -> None:
    """Add ``--area``, ``--keep-out`` and ``--target``, which set no attribute by default.
    ``default``: help text for that case."""
    absent: dict[str, Any] = {"default": argparse.SUPPRESS}
    corners: dict[str, Any] = {"metavar": "'X,Y X,Y X,Y ...'", "type": polygon, **absent}
    text = f"this polygon, map frame, m{default}"
    parser.add_argument("--area", **corners, help=f"land inside {text}")
    text = f"never land in {text}; may be given several times"
    parser.add_argument("--keep-out", **corners, action="append", help=text)
    text = "land near this position, or none; as --area" if default else "land near this position"
    parser.add_argument("--target", metavar="X,Y", type=position, **absent, help=text)


def landing_of(options: argparse.Namespace) -> dict[str, Any]:
    """Return the argument ``landing`` of `replay.replay`."""
    found = {name: getattr(options, name) for name in ("area", "target") if name in options}
    if "keep_out" in options:
        found["keep_out"], *others = options.keep_out
        found["keep_outs"] = [corners for corners in others if corners is not None]
    return found


def polygon(text: str) -> list[list[float]] | None:
    """Type of an option: ``'0,0 9,0 9,9'``, or ``none``."""
    wanted = "a polygon of three or more corners X,Y in m, separated by spaces"
    return None if text.strip() == "none" else _pairs(text, wanted, 3, math.inf)


def position(text: str) -> list[float] | None:
    """Type of an option: ``3,-4``, or ``none``."""
    return None if text.strip() == "none" else _pairs(text, "a position X,Y in m")[0]


def origin(text: str) -> list[float]:
    """Type of an option: ``46.2,8.6``, latitude and longitude, deg."""
    wanted = "LAT,LON in deg, latitude first"
    ((north, east),) = _pairs(text, wanted)
    if abs(north) > 90.0 or abs(east) > 360.0:
        raise argparse.ArgumentTypeError(f"'{text}' is not {wanted}")
    return [north, east]


def vehicle(text: str) -> dict[str, float]:
    """Type of an option: ``0.6,0.08``, diameter and clearance, as parameters of the vehicle."""
    ((diameter, clearance),) = _pairs(text, "a diameter and a clearance D,C in m")
    default = VehicleConfig()
    pad = float(f"{default.pad_radius * diameter / default.diameter:.3g}")
    return {"vehicle.diameter": diameter, "vehicle.clearance": clearance, "vehicle.pad_radius": pad}


def _pairs(text: str, wanted: str, least: int = 1, most: float = 1) -> list[list[float]]:
    """Convert ``least`` to ``most`` pairs of finite numbers; ``wanted`` describes them."""
    with contextlib.suppress(ValueError):
        pairs = [[float(v) for v in pair.split(",")] for pair in text.split()]
        finite = all(len(pair) == 2 and all(map(math.isfinite, pair)) for pair in pairs)
        if finite and least <= len(pairs) <= most:
            return pairs
    raise argparse.ArgumentTypeError(f"'{text}' is not {wanted}")


def show_result(options: argparse.Namespace, result: Any, *lines: str) -> None:
    """Print a result as JSON with ``--json``, else its table and ``lines``."""
    out = {"out": str(result.out)} if hasattr(result, "out") else {}
    show(options, {**out, **result.as_dict()}, "\n".join([result.table(), *lines]))


def show(options: argparse.Namespace, content: Mapping[str, Any], text: str) -> None:
    print(json_text(content) if options.json else text)


def json_text(content: Mapping[str, Any]) -> str:
    return json.dumps(content, indent=2, allow_nan=False)
