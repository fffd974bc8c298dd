# SPDX-License-Identifier: Apache-2.0
"""Lost scans, overload, and topics with several publishers."""

from __future__ import annotations

import time
from pathlib import Path

from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.nodes.diagnostics import WARN, Durations, Problems, Status


class Publishers:
    """Number of publishers of a topic, with a warning while there is more than one. ``reason`` is
    the key of the problem, ``effect`` the consequence for the text."""

    def __init__(self, topic: str, reason: str, effect: str, problems: Problems) -> None:
        self.number = 0
        self._topic, self._reason, self._effect = topic, reason, effect
        self._problems = problems

    def changed(self, number: int) -> None:
        """Set the number of publishers."""
        before, self.number = self.number, number
        if number > max(before, 1):
            self._problems.report(self._reason, self._text())

    def add_warning(self, status: Status) -> None:
        """Add a warning while there is more than one."""
        if self.number > 1:
            status.note(WARN, self._text())

    def _text(self) -> str:
        text = f"{self.number} publishers on '{self._topic}': {self._effect}"
        return f"{text} (one that was killed counts until its lease ends)"


class ScanGaps:
    """Detection of gaps in the sequence numbers of scans, reported as ``scan_lost``; not with two
    publishers, because each numbers its own messages."""

    def __init__(self, topic: str, problems: Problems) -> None:
        self._topic, self._problems = topic, problems
        effect = "their scans are mapped as if of one lidar"
        self.publishers = Publishers(topic, "scan_publishers", effect, problems)
        self._last = 0

    def on_publishers(self, number: int) -> None:
        self.publishers.changed(number)
        self._last = 0

    def on_scan(self, number: int | None) -> None:
        """Check the sequence number of a scan; None if the middleware has none (Cyclone DDS)."""
        last, self._last = self._last, number or 0
        missing = self._last - last - 1
        if last > 0 and missing > 0 and self.publishers.number <= 1:
            text = f"{missing} scans on '{self._topic}' were lost before number {number}: best"
            text += " effort, or more than the middleware queues (50) were waiting"
            self._problems.report("scan_lost", text, missing)


def best_effort_hint(topic: str) -> str:
    """Return the setting to change if scans are sent but none arrives by best effort."""
    try:
        limit = int(Path("/proc/sys/net/core/rmem_max").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return ""
    text = f"; best effort loses scans of more than {limit} bytes (net.core.rmem_max)"
    return f"{text}: set qos_overrides.{topic}.subscription.reliability to reliable"


OVERLOADED_SHARE = 0.25
"""Fraction of the allowance that applies while the node is overloaded."""
CALM_S = 5.0
"""Time without a dropped scan after which the node is no longer overloaded."""
MIN_ALLOWANCE_S = 0.1
"""Waiting time up to which scans are always mapped, so that some are mapped at any load."""


def allowance(config: Config, work_ms: float) -> float:
    """Return the waiting time of a scan up to which the map stays younger than ``warn_age``, s.
    ``work_ms``: time to map a scan and publish the map; counted twice, because a scan may wait for
    it before it is mapped."""
    max_age = config.diagnostics.warn_age
    publish_wait = min(1.0 / config.publish.rate, 0.5 * max_age)
    return max(max_age - publish_wait - 2e-3 * work_ms, MIN_ALLOWANCE_S)


class Overload:
    """Drop scans that waited in the middleware for longer than `allowance`; after the first dropped
    scan than a quarter of it, so that drops are spread evenly. ``dropped``: number of dropped
    scans; ``waits``: waiting times of the others."""

    def __init__(self, topic: str, problems: Problems) -> None:
        self.dropped = 0
        self.waits = Durations()
        self._topic, self._problems = topic, problems
        self._overloaded_until = 0.0

    def admits(self, received_ns: int, config: Config, work_ms: float) -> bool:
        """Return whether to map a scan that the middleware received at ``received_ns`` by the
        system clock, 0 if unknown. ``config``, ``work_ms``: as for `allowance`."""
        waited = max(1e-9 * (time.time_ns() - received_ns), 0.0) if received_ns > 0 else 0.0
        now = time.monotonic()
        limit = allowance(config, work_ms)
        if now < self._overloaded_until:
            limit = max(OVERLOADED_SHARE * limit, MIN_ALLOWANCE_S)
        if waited <= limit:
            self.waits.add(1e3 * waited)
            return True
        self._overloaded_until = now + CALM_S
        self.dropped += 1
        text = f"a scan on '{self._topic}' waited {waited:.2f} s and is dropped: scans come faster"
        text += " than they can be mapped (diagnostics.warn_age)"
        self._problems.report("overload", text)
        return False
