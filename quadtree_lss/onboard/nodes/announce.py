# SPDX-License-Identifier: Apache-2.0
"""What a node says of itself when it starts: one line, by which its log can be read later."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from typing import Any

from rclpy.node import Node

import quadtree_lss
from quadtree_lss import build
from quadtree_lss.onboard.config.loading import read_values
from quadtree_lss.onboard.config.settings import Config, ConfigError, parameters, values_from_config

ROS_TOPICS = ("/clock", "/parameter_events", "/rosout")


def announce(node: Node, config: Config) -> None:
    """One line: version and build, what is configured and by whom, domain, vehicle, topics."""
    parts = (
        f"quadtree_lss {quadtree_lss.__version__} ({build.name()})",
        configuration_text(config, sys.argv),
        *ground_text(config),
        f"takes {topics_text(node.subscriptions)}",
        f"sends {topics_text(node.publishers)}",
    )
    node.get_logger().info("; ".join(parts))


def configuration_text(config: Config, arguments: Sequence[str]) -> str:
    """What differs from the defaults, each with the file that sets it.

    Args:
        config: What holds.
        arguments: Of the command line; what stands in none of its files came otherwise.
    """
    values = values_from_config(config)
    changed = [row.name for row in parameters() if values[row.name] != row.default]
    files = [path for option, path in _pairs(arguments) if option == "--params-file"]
    if not changed:
        return f"configuration: the defaults{' (as in ' + ', '.join(files) + ')' if files else ''}"
    origin = _origins(arguments)
    by_file: dict[str, list[str]] = {}
    for name in changed:
        by_file.setdefault(origin.get(name, "command line"), []).append(f"{name}={values[name]}")
    groups = [f"{', '.join(names)} (from {file})" for file, names in by_file.items()]
    unused = [f"{path} (nothing but defaults)" for path in files if path not in by_file]
    return f"configuration other than the defaults: {', '.join([*groups, *unused])}"


def ground_text(config: Config) -> list[str]:
    """Domain, cells and vehicle."""
    d, lss = config.domain, config.lss
    sizes = [d.size / 2**level for level in (d.min_level, d.max_level)]
    return [
        f"domain x {d.xmin:g} ... {d.xmin + d.size:g}, y {d.ymin:g} ... {d.ymin + d.size:g} m"
        f" in frame '{config.frames.map}', cells {sizes[0]:g} ... {sizes[1]:g} m",
        f"vehicle of {lss.vehicle_diameter:g} m diameter, margin {lss.margin:g} m",
    ]


def topics_text(ends: Iterable[Any]) -> str:
    """Publishers' or subscriptions' topics as remapped, each with its quality of service."""
    found: dict[str, list[str]] = {}
    for end in ends:
        if end.topic_name not in ROS_TOPICS:
            qos = end.qos_profile
            words = [qos.reliability.name.lower().replace("_", " ")]
            words += ["latched"] * (qos.durability.name == "TRANSIENT_LOCAL")
            found.setdefault(end.topic_name, []).append(", ".join([*words, str(qos.depth)]))
    return ", ".join(f"{topic} ({' and '.join(ways)})" for topic, ways in found.items())


def _pairs(arguments: Sequence[str]) -> list[tuple[str, str]]:
    return list(zip(arguments, arguments[1:], strict=False))


def _origins(arguments: Sequence[str]) -> dict[str, str]:
    """The last file of the command line that sets a parameter, by the parameter's name."""
    origin: dict[str, str] = {}
    for option, value in _pairs(arguments):
        if option == "--params-file":
            try:
                origin |= dict.fromkeys(read_values(value), value)
            except ConfigError:  # in ROS's own form, which is wider than ours
                continue
        elif option in ("-p", "--param"):
            origin[value.partition(":=")[0]] = "command line"
    return origin
