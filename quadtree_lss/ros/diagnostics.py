# SPDX-License-Identifier: Apache-2.0
"""The counters of a node on ``/diagnostics``."""

from __future__ import annotations

from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile

from quadtree_lss.ros.problems import Problems

OK, WARN = DiagnosticStatus.OK, DiagnosticStatus.WARN


class Diagnostics:
    """Publishes one status of a node at a set rate, on a steady clock.

    Args:
        node: Publishes; its full name is the status's.
        rate: Hz.
        problems: Its counters are appended; a new problem since the last status is a warning.
    """

    def __init__(self, node: Node, rate: float, problems: Problems) -> None:
        self._node = node
        self._problems = problems
        self._told = 0
        self._values: dict[str, object] = {}
        self._level, self._text = WARN, "no data yet"
        self._publisher = node.create_publisher(
            DiagnosticArray, "/diagnostics", QoSProfile(depth=10)
        )
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(1.0 / rate, self._send, clock=clock)

    def set(self, text: str, values: Mapping[str, object], *, warn: bool = False) -> None:
        """State for the next status; ``values`` are laid over those that were set before."""
        self._level, self._text = (WARN if warn else OK), text
        self._values.update(values)

    def _send(self) -> None:
        total = self._problems.counts.total()
        level, text = self._level, self._text
        if total > self._told:
            level, text = WARN, f"{text}; {total - self._told} new problems"
        self._told = total
        status = DiagnosticStatus(level=level, message=text)
        status.name = self._node.get_fully_qualified_name().lstrip("/")
        status.hardware_id = self._node.get_namespace()
        rows = {**self._values, **{f"problems.{k}": n for k, n in self._problems.counts.items()}}
        status.values = [KeyValue(key=key, value=str(value)) for key, value in rows.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
