# SPDX-License-Identifier: Apache-2.0
"""What all nodes have: parameters, counted problems, and their state on ``/diagnostics``."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import QoSProfile

from quadtree_lss import build
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.nodes.diagnostics import WARN, Problems, Status
from quadtree_lss.onboard.nodes.executor import steady_timer
from quadtree_lss.onboard.nodes.parameters import NodeParameters

MEANINGFUL_LATENCY_S = 600.0
"""Beyond, stamps and the node's clock are not of the same time: a bag without ``/clock``."""


class BaseNode(Node):
    """A node with the parameters of the table, one of whose statuses is sent at
    ``publish.diagnostics_rate``, on a steady clock: what `_collect` fills in, and the counters of
    its problems, of which a new one is a warning."""

    def __init__(self, name: str) -> None:
        super().__init__(name, automatically_declare_parameters_from_overrides=True)
        self._settings = NodeParameters(self, self._reconfigure)
        self._problems = Problems(self.get_logger())
        self._build, self._problems_told = build.name(), 0
        self._statuses = self.create_publisher(
            DiagnosticArray, "/diagnostics", QoSProfile(depth=10)
        )
        steady_timer(self, 1.0 / self._config.publish.diagnostics_rate, self._send_status)

    @property
    def _config(self) -> Config:
        """As it is now."""
        return self._settings.config

    def _reconfigure(self, config: Config) -> None:
        """Live parameters were set."""

    def _collect(self, status: Status) -> None:
        """Says how the node is."""
        raise NotImplementedError

    def _latency_ms(self, stamp_ns: int) -> float | None:
        """From a stamp to now by the node's clock; None if the two are not of the same time."""
        latency = 1e-9 * (self.get_clock().now().nanoseconds - stamp_ns)
        return 1e3 * latency if abs(latency) < MEANINGFUL_LATENCY_S else None

    def _send_status(self) -> None:
        state, problems = Status(), self._problems
        state.add({"build": self._build})
        self._collect(state)
        total = problems.counts.total()
        if total > self._problems_told:
            new = total - self._problems_told
            state.note(WARN, f"{new} new problems, the last: {problems.latest}")
        self._problems_told = total
        state.add({f"problems.{key}": n for key, n in problems.counts.items()})
        status = DiagnosticStatus(level=state.level, message=state.text)
        status.name = self.get_fully_qualified_name().lstrip("/")
        status.hardware_id = self.get_namespace()
        status.values = [KeyValue(key=key, value=str(v)) for key, v in state.values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._statuses.publish(message)
