# SPDX-License-Identifier: Apache-2.0
"""ROS parameters of a node, declared from the table of ``config.settings``."""

from __future__ import annotations

import difflib
import itertools
import math
import sys
from collections.abc import Callable, Iterable, Mapping

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import DurabilityPolicy, HistoryPolicy, ReliabilityPolicy

from quadtree_lss.onboard.config.loading import ROS_OWN, check_reaches
from quadtree_lss.onboard.config.settings import (
    Config,
    ConfigError,
    Parameter,
    config_from_values,
    parameters,
    unknown_parameter,
    values_from_config,
)

QOS = "qos_overrides."
LIVE_NODES = {"vehicle": "lss_node", "lss": "lss_node", "autopilot": "autopilot_node"}
"""Node in which live changes of a section have an effect; for other sections every node."""
ROS_TOPICS = ("/clock", "/parameter_events", "/rosout")

#: QoS policies that can be overridden, and their values; empty for a number.
QOS_POLICIES: dict[str, list[str]] = {
    "depth": [],
    "durability": DurabilityPolicy.short_keys(),
    "history": HistoryPolicy.short_keys(),
    "reliability": ReliabilityPolicy.short_keys(),
}


def descriptor(row: Parameter) -> ParameterDescriptor:
    """Describe a row of the table for ``ros2 param describe``."""
    result = ParameterDescriptor(name=row.name, read_only=not row.live)
    result.description = f"{row.doc} [{row.unit}]" if row.unit else row.doc
    if row.choices:
        result.additional_constraints = "one of " + ", ".join(row.choices)
    if math.isfinite(row.low) and math.isfinite(row.high):
        if row.type is int:
            bounds = IntegerRange(from_value=int(row.low), to_value=int(row.high), step=1)
            result.integer_range = [bounds]
        elif row.type is float:
            span = FloatingPointRange(from_value=float(row.low), to_value=float(row.high))
            result.floating_point_range = [span]
    return result


def checked_qos_overrides(values: Mapping[str, object]) -> list[tuple[str, str]]:
    """Return the topics whose QoS is overridden, each with ``publisher`` or ``subscription``.
    Raises `ConfigError` for a name not of the form ``qos_overrides.TOPIC.subscription.POLICY``, an
    unknown policy (names the nearest one) or an invalid value."""
    found = []
    endings = [f"{end}.{p}" for end in ("subscription", "publisher") for p in QOS_POLICIES]
    for name, value in values.items():
        topic, _, ending = name.removeprefix(QOS).partition(".")
        if not name.startswith(QOS) or topic in ROS_TOPICS:
            continue
        if ending not in endings:
            near = difflib.get_close_matches(ending, endings, n=1, cutoff=0.0)[0]
            msg = f"unknown parameter {name!r}; did you mean '{QOS}{topic}.{near}'?"
            raise ConfigError(msg)
        entity, _, policy = ending.partition(".")
        words = [word for word in QOS_POLICIES[policy] if word != "unknown"]
        if words and not (isinstance(value, str) and value.lower() in words):
            msg = f"{name} = {value!r} is not one of {', '.join(words)}"
            raise ConfigError(msg)
        whole = isinstance(value, int) and not isinstance(value, bool)
        if not words and not (whole and 0 <= value < 2**31):  # type: ignore[operator]
            msg = f"{name} = {value!r} is not a number of messages"
            raise ConfigError(msg)
        found.append((topic, entity))
    return found


class NodeParameters:
    """Configuration of a node from its ROS parameters.

    The node needs ``automatically_declare_parameters_from_overrides=True``; otherwise overrides of
    unknown names are not visible. ``changed`` is called with the new configuration after live
    parameters were set; those of other executables than ``kind`` cannot be changed. Raises
    `ConfigError` for wrong parameters, or a parameter file without a section for this node.
    ``given``: names that the command line or a file set at the start.
    """

    def __init__(self, node: Node, changed: Callable[[Config], None], kind: str) -> None:
        for option, path in itertools.pairwise(sys.argv):
            if option == "--params-file":
                check_reaches(path, node.get_fully_qualified_name())
        given = node.get_parameters_by_prefix("")
        # Parameters are declared again below, with descriptors; QoS overrides by rclpy.
        for name in given:
            if not ROS_OWN.fullmatch(name) or name.startswith(QOS):
                node.undeclare_parameter(name)
        own = {name: item.value for name, item in given.items() if not ROS_OWN.fullmatch(name)}
        self.given = frozenset(own)
        self.config = _checked(config_from_values(own))
        overrides = {name: item.value for name, item in given.items()}
        self._overridden = sorted(set(checked_qos_overrides(overrides)))
        values = values_from_config(self.config)
        for row in parameters():
            node.declare_parameter(
                row.name, values[row.name], descriptor(row), ignore_override=True
            )
        self._changed, self._kind = changed, kind
        node.add_pre_set_parameters_callback(_converted)
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def warn_unused(self, node: Node) -> None:
        """Warn of QoS overrides for topics that the node does not have."""
        topics = {
            "subscription": sorted({item.topic_name for item in node.subscriptions}),
            "publisher": sorted({item.topic_name for item in node.publishers}),
        }
        for topic, entity in self._overridden:
            if topic not in topics[entity]:
                node.get_logger().warning(
                    f"{QOS}{topic}.{entity}.* has no effect: this node has no {entity} of it,"
                    f" but of {', '.join(topics[entity])}"
                )

    def _check(self, changes: Iterable[RosParameter]) -> SetParametersResult:
        try:
            values = values_from_config(self._with(changes))
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        current = values_from_config(self.config)
        for name in [item.name for item in changes if item.name in current]:
            owner = LIVE_NODES.get(name.partition(".")[0], self._kind)
            if owner != self._kind and values[name] != current[name]:
                reason = f"{name} has an effect in {owner}, not in {self._kind}: set it there"
                return SetParametersResult(successful=False, reason=reason)
        return SetParametersResult(successful=True)

    def _apply(self, changes: Iterable[RosParameter]) -> None:
        config = self._with(changes)
        if config != self.config:
            self.config = config
            self._changed(config)

    def _with(self, changes: Iterable[RosParameter]) -> Config:
        own = {item.name: item.value for item in changes if not ROS_OWN.fullmatch(item.name)}
        return _checked(config_from_values(own, self.config))


def _converted(changes: list[RosParameter]) -> list[RosParameter]:
    """Convert integers of float parameters, before rclpy checks types. Raises rclpy's exception,
    with the nearest name in its text, for a name that is neither in the table nor ROS's own."""
    types = {row.name: row.type for row in parameters()}
    result = []
    for item in changes:
        if item.name not in types and not ROS_OWN.fullmatch(item.name):
            error = ParameterNotDeclaredException([item.name])
            error.args = (unknown_parameter(item.name),)
            raise error
        if types.get(item.name) is float and item.type_ is RosParameter.Type.INTEGER:
            item = RosParameter(item.name, value=float(item.value))
        result.append(item)
    return result


def _checked(config: Config) -> Config:
    """Return the configuration. Raises `ConfigError` if a path cannot be that of a file."""
    for name, path in (("map_file", config.map_file.path), ("checkpoint", config.checkpoint.path)):
        if path and (path.rpartition("/")[2] in ("", ".", "..") or "\0" in path):
            msg = f"{name}.path = {path!r} is not the name of a file"
            raise ConfigError(msg)
    return config
