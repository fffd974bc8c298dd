# SPDX-License-Identifier: Apache-2.0
"""The parameter table of ``core.config`` declared on a node."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

from quadtree_lss.core.config import (
    Config,
    ConfigError,
    Parameter,
    config_from_values,
    parameters,
    values_from_config,
)

#: Parameters that every ROS node has, whatever its package.
ROS_OWN = ("use_sim_time", "start_type_description_service")
ROS_OWN_PREFIXES = ("qos_overrides.",)


def is_ros_own(name: str) -> bool:
    """True for parameters that belong to ROS itself."""
    return name in ROS_OWN or name.startswith(ROS_OWN_PREFIXES)


def descriptor(row: Parameter) -> ParameterDescriptor:
    """What ``ros2 param describe`` shows of a row of the table."""
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


class NodeParameters:
    """The configuration of a node, kept in step with its ROS parameters.

    The node must have been made with ``automatically_declare_parameters_from_overrides=True``:
    that is how the overrides of command line and parameter files can be seen at all, those of
    unknown name included.

    Args:
        node: Its overrides are checked, then every row of the table is declared on it.
        changed: Called with the new configuration after live parameters were set.

    Attributes:
        config: As it is now.
        given: Names that the command line or a file set at the start.

    Raises:
        ConfigError: unknown key (names the nearest one), wrong type or range, values that
            contradict one another.
    """

    def __init__(self, node: Node, changed: Callable[[Config], None] | None = None) -> None:
        given = node.get_parameters_by_prefix("")
        # Declared anew, with descriptors, by whoever they belong to.
        for name in given:
            if not is_ros_own(name) or name.startswith(ROS_OWN_PREFIXES):
                node.undeclare_parameter(name)
        own = {name: item.value for name, item in given.items() if not is_ros_own(name)}
        self.given = frozenset(own)
        self.config = config_from_values(own)
        values = values_from_config(self.config)
        for row in parameters():
            node.declare_parameter(
                row.name, values[row.name], descriptor(row), ignore_override=True
            )
        self._changed = changed
        node.add_on_set_parameters_callback(self._check)
        node.add_post_set_parameters_callback(self._apply)

    def _check(self, changes: Iterable[RosParameter]) -> SetParametersResult:
        try:
            self._with(changes)
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, changes: Iterable[RosParameter]) -> None:
        config = self._with(changes)
        if config != self.config:
            self.config = config
            if self._changed is not None:
                self._changed(config)

    def _with(self, changes: Iterable[RosParameter]) -> Config:
        own = {item.name: item.value for item in changes if not is_ros_own(item.name)}
        return config_from_values(own, self.config)
