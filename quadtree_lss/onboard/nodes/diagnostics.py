# SPDX-License-Identifier: Apache-2.0
"""The state of a node on ``/diagnostics``, at a level that its data's age sets."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile

from quadtree_lss import build
from quadtree_lss.onboard.config.settings import DiagnosticsConfig
from quadtree_lss.onboard.nodes.monitor import Arrivals, Span
from quadtree_lss.onboard.nodes.problems import Problems

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR

MEANINGFUL_LATENCY_S = 600.0
"""Beyond, stamps and the node's clock are not of the same time: a bag without ``/clock``."""


class Status:
    """What a node has to say: the worst of its levels, one text, values by key."""

    def __init__(self) -> None:
        self.level = OK
        self.values: dict[str, object] = {}
        self._notes: list[tuple[bytes, str]] = []

    def note(self, level: bytes, text: str) -> None:
        """Something to say at a level."""
        self.level = max(self.level, level)
        self._notes.append((level, text))

    def add(self, values: Mapping[str, object]) -> None:
        """Values by key; a mean and worst duration becomes two keys, None is left out."""
        for key, value in values.items():
            if isinstance(value, Span):
                self.values[key] = f"{value.mean:.2f}"
                self.values[f"{key}.worst"] = f"{value.worst:.2f}"
            elif value is not None:
                self.values[key] = f"{value:.2f}" if isinstance(value, float) else value

    def judge_age(self, what: str, topic: str, of: Arrivals, limits: DiagnosticsConfig) -> None:
        """Warning or error if the last message of a kind is too old."""
        age = of.age()
        self.add({f"{what}.age_s": age, f"{what}.rate_hz": of.rate(), f"{what}.received": of.count})
        if age > limits.warn_age:
            level = ERROR if age > limits.error_age else WARN
            lack = "for" if of.count else "since the start,"
            self.note(level, f"no {what} on '{topic}' {lack} {age:.1f} s")

    def judge_delay(self, text: str, delay: Span | None, limits: DiagnosticsConfig) -> None:
        """Warning or error if what is sent was too old already: ``text`` and for how long."""
        if delay is not None and delay.worst > 1e3 * limits.warn_age:
            level = ERROR if delay.worst > 1e3 * limits.error_age else WARN
            self.note(level, f"{text} {1e-3 * delay.worst:.1f} s")

    @property
    def text(self) -> str:
        """The worst first."""
        ordered = sorted(self._notes, key=lambda note: note[0], reverse=True)
        return "; ".join(text for _, text in ordered)


class Diagnostics:
    """Publishes one status of a node at a set rate, on a steady clock.

    Args:
        node: Publishes; its full name is the status's.
        rate: Hz.
        problems: Its counters are appended; a new problem since the last status is a warning.
        collect: Fills in a fresh status whenever one is due.
    """

    def __init__(
        self, node: Node, rate: float, problems: Problems, collect: Callable[[Status], None]
    ) -> None:
        self._node = node
        self._problems = problems
        self._collect = collect
        self._told = 0
        self._build = build.name()
        self._publisher = node.create_publisher(
            DiagnosticArray, "/diagnostics", QoSProfile(depth=10)
        )
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(1.0 / rate, self._send, clock=clock)

    def latency_ms(self, stamp_ns: int) -> float | None:
        """From a stamp to now by the node's clock; None if the two are not of the same time."""
        latency = 1e-9 * (self._node.get_clock().now().nanoseconds - stamp_ns)
        return 1e3 * latency if abs(latency) < MEANINGFUL_LATENCY_S else None

    def _send(self) -> None:
        state = Status()
        state.add({"build": self._build})
        self._collect(state)
        total = self._problems.counts.total()
        if total > self._told:
            latest = self._problems.latest
            state.note(WARN, f"{total - self._told} new problems, the last: {latest}")
        self._told = total
        state.add({f"problems.{key}": n for key, n in self._problems.counts.items()})
        status = DiagnosticStatus(level=state.level, message=state.text)
        status.name = self._node.get_fully_qualified_name().lstrip("/")
        status.hardware_id = self._node.get_namespace()
        status.values = [KeyValue(key=key, value=str(v)) for key, v in state.values.items()]
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)
