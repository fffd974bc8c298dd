# SPDX-License-Identifier: Apache-2.0
"""Scans that come faster than they can be mapped: which are left out, how old others are."""

from __future__ import annotations

import time

from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.nodes.monitor import Durations
from quadtree_lss.onboard.nodes.problems import Problems

SHARE = 0.25
"""Of the allowance, which a scan may have waited while scans are being left out."""
CALM_S = 5.0
"""For how long after the last scan that was left out."""
LEAST_S = 0.1
"""A scan that waited no longer is mapped however long that takes, or none would ever be."""


def allowance(config: Config, work_ms: float) -> float:
    """How long a scan may have waited, s, for the map to stay younger than ``warn_age``.

    Args:
        config: Of which ``diagnostics.warn_age`` and ``publish.rate`` matter.
        work_ms: What it takes to map a scan and publish the map; it may have to wait for as much.
    """
    young = config.diagnostics.warn_age
    return max(young - min(1.0 / config.publish.rate, 0.5 * young) - 2e-3 * work_ms, LEAST_S)


class Overload:
    """Judges scans by how long they have waited in the middleware, by this computer's clock.

    A short hold-up leaves nothing out: a scan may wait as long as the map stays young enough. Once
    one has waited longer the node is overloaded, and only scans that have waited for a quarter of
    that are mapped: the map is much younger than it need be, and what is left out lies scattered.

    Args:
        topic: Full name.
        problems: Where scans that are left out are counted as ``overload``.

    Attributes:
        dropped: Scans left out.
        waits: How long the others had waited.
    """

    def __init__(self, topic: str, problems: Problems) -> None:
        self.dropped = 0
        self.waits = Durations()
        self._topic, self._problems = topic, problems
        self._overloaded_until = 0.0

    def takes(self, received_ns: int, config: Config, work_ms: float) -> bool:
        """True if a scan is to be mapped.

        Args:
            received_ns: When the middleware received it, by the system's clock; 0 if it does not
                say.
            config, work_ms: As of `allowance`.
        """
        waited = max(1e-9 * (time.time_ns() - received_ns), 0.0) if received_ns > 0 else 0.0
        now = time.monotonic()
        limit = allowance(config, work_ms)
        if now < self._overloaded_until:
            limit = max(SHARE * limit, LEAST_S)
        if config.qos.overload == "all" or waited <= limit:
            self.waits.add(1e3 * waited)
            return True
        self._overloaded_until = now + CALM_S
        self.dropped += 1
        text = (
            f"a scan on '{self._topic}' waited {waited:.2f} s and is left out: scans come faster"
            " than they can be mapped (qos.overload, diagnostics.warn_age)"
        )
        self._problems.report("overload", text)
        return False
