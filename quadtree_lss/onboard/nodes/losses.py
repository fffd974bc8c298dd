# SPDX-License-Identifier: Apache-2.0
"""Scans that are lost on the way, or come faster than they can be mapped; and whose they are."""

from __future__ import annotations

import time
from pathlib import Path

from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.nodes.diagnostics import WARN, Durations, Problems, Status


class Publishers:
    """Counts the publishers of a topic that match at present (``number``); of more than one it
    tells ``problems`` the ``reason`` and the ``effect``, and `judge` the status, while they are."""

    def __init__(self, topic: str, reason: str, effect: str, problems: Problems) -> None:
        self.number = 0
        self._topic, self._reason, self._effect = topic, reason, effect
        self._problems = problems

    def changed(self, number: int) -> None:
        """Publishers came or went."""
        before, self.number = self.number, number
        if number > max(before, 1):
            self._problems.report(self._reason, self._text())

    def judge(self, status: Status) -> None:
        """Warning while there is more than one."""
        if self.number > 1:
            status.note(WARN, self._text())

    def _text(self) -> str:
        return (
            f"{self.number} publishers on '{self._topic}': {self._effect} (one that was killed"
            " counts until its lease ends)"
        )


class ScanGaps:
    """Looks for gaps in the numbers that a publisher gives its messages.

    Two publishers number theirs apart, and a message does not say whose it is: while there are two,
    gaps cannot be found, and that there are two is a problem of its own. ``topic``: full name.
    ``problems``: where losses are counted as ``scan_lost``.
    """

    def __init__(self, topic: str, problems: Problems) -> None:
        self._topic = topic
        self._problems = problems
        effect = "their scans are mapped as they come, as if of one lidar"
        self.publishers = Publishers(topic, "scan_publishers", effect, problems)
        self._last = 0

    def on_publishers(self, number: int) -> None:
        """Publishers came or went."""
        self.publishers.changed(number)
        self._last = 0

    def on_scan(self, number: int | None) -> None:
        """A scan arrived with this number; None of a middleware that gives none (Cyclone DDS)."""
        number = number or 0
        last, self._last = self._last, number
        missing = number - last - 1
        if last > 0 and missing > 0 and self.publishers.number <= 1:
            text = (
                f"{missing} scans on '{self._topic}' were lost before number {number}: best"
                " effort, or more than the middleware queues (50) were waiting"
            )
            self._problems.report("scan_lost", text, missing)


def best_effort_hint(topic: str) -> str:
    """What to set if scans are sent on a topic and none comes by best effort."""
    try:
        limit = int(Path("/proc/sys/net/core/rmem_max").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return ""
    return (
        f"; best effort loses scans of more than {limit} bytes (net.core.rmem_max): set"
        f" qos_overrides.{topic}.subscription.reliability to reliable"
    )


SHARE = 0.25
"""Of the allowance, which a scan may have waited while scans are being left out."""
CALM_S = 5.0
"""For how long after the last scan that was left out."""
LEAST_S = 0.1
"""A scan that waited no longer is mapped however long that takes, or none would ever be."""


def allowance(config: Config, work_ms: float) -> float:
    """How long a scan may have waited, s, for the map to stay younger than ``warn_age``.
    ``config``: of which ``diagnostics.warn_age`` and ``publish.rate`` matter. ``work_ms``: what it
    takes to map a scan and publish the map; it may have to wait for as much."""
    young = config.diagnostics.warn_age
    return max(young - min(1.0 / config.publish.rate, 0.5 * young) - 2e-3 * work_ms, LEAST_S)


class Overload:
    """Judges scans by how long they have waited in the middleware, by this computer's clock.

    A short hold-up leaves nothing out: a scan may wait as long as the map stays young enough. Once
    one has waited longer the node is overloaded, and only scans that have waited for a quarter of
    that are mapped: the map is much younger than it need be, and what is left out (``dropped``)
    lies scattered. ``waits`` holds how long the others had waited.
    """

    def __init__(self, topic: str, problems: Problems) -> None:
        self.dropped = 0
        self.waits = Durations()
        self._topic, self._problems = topic, problems
        self._overloaded_until = 0.0

    def takes(self, received_ns: int, config: Config, work_ms: float) -> bool:
        """True if a scan is to be mapped. ``received_ns``: when the middleware received it, by the
        system's clock; 0 if it does not say. ``config``, ``work_ms``: as of `allowance`."""
        waited = max(1e-9 * (time.time_ns() - received_ns), 0.0) if received_ns > 0 else 0.0
        now = time.monotonic()
        limit = allowance(config, work_ms)
        if now < self._overloaded_until:
            limit = max(SHARE * limit, LEAST_S)
        if waited <= limit:
            self.waits.add(1e3 * waited)
            return True
        self._overloaded_until = now + CALM_S
        self.dropped += 1
        text = (
            f"a scan on '{self._topic}' waited {waited:.2f} s and is left out: scans come faster"
            " than they can be mapped (diagnostics.warn_age)"
        )
        self._problems.report("overload", text)
        return False
