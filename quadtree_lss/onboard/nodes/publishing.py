# SPDX-License-Identifier: Apache-2.0
"""Publishing of changes at a limited rate."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.node import Node

from quadtree_lss.onboard.nodes.qos import steady_timer

WAIT_FRACTION = 0.6
"""Wait for the next change beyond the due time, as a fraction of the interval between changes."""


class ChangePublisher:
    """Call ``publish`` after changes, on average at most ``rate`` times per second.

    Of regular changes, the one closest to the due time is published when it arrives. If no further
    change follows, a timer on a steady clock publishes the last state, also when ``/clock`` has
    stopped. The timer also publishes changes that occur during publishing.
    """

    def __init__(self, node: Node, rate: float, publish: Callable[[], None]) -> None:
        self._period_ns = round(1e9 / rate)
        self._publish = publish
        self._due_ns = self._changed_ns = 0
        self._is_publishing = False
        self._timer = steady_timer(node, 1.0 / rate, self._send)
        self._timer.cancel()

    def changed(self) -> None:
        """Publish the changed state: now, with the next change, or soon after the due time."""
        now_ns = time.monotonic_ns()
        interval_ns = min(now_ns - self._changed_ns, self._period_ns)
        self._changed_ns = now_ns
        wait_ns = self._due_ns - now_ns
        soon = wait_ns <= interval_ns // 2
        if soon and not self._is_publishing:
            self._send()
        elif self._timer.is_canceled():
            self._timer.timer_period_ns = (
                1 if soon else wait_ns + round(WAIT_FRACTION * interval_ns)
            )
            self._timer.reset()

    def now(self) -> None:
        """Publish the state immediately, whatever the rate."""
        self._due_ns = min(self._due_ns, time.monotonic_ns())
        self._send()

    def _send(self) -> None:
        self._timer.cancel()
        # Keep the publishing phase after a late send.
        now_ns = time.monotonic_ns()
        in_phase = now_ns - self._due_ns < self._period_ns
        self._due_ns = (self._due_ns if in_phase else now_ns) + self._period_ns
        self._is_publishing = True
        try:
            self._publish()
        finally:
            self._is_publishing = False


class MapStamps:
    """Stamps of published maps. Consecutive maps have different stamps, because subscribers match
    the two messages of a map by its stamp.

    If the map changed but its newest scan did not (a late scan, a loaded file), the stamp is one
    nanosecond later than the last. Only the empty map has stamp 0. Set ``content_changed`` when the
    map differs from the last published one.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Reset to the empty map."""
        self.content_changed = False
        self._newest_ns = self._last_ns = 0

    def next(self, newest_ns: int) -> int:
        """Return the stamp for publishing a map whose newest scan has the stamp ``newest_ns``."""
        stamp_ns = self._last_ns if newest_ns == self._newest_ns else newest_ns
        if self.content_changed and stamp_ns == self._last_ns:
            stamp_ns += 1
        self.content_changed = False
        self._newest_ns, self._last_ns = newest_ns, stamp_ns
        return stamp_ns
