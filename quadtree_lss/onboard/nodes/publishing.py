# SPDX-License-Identifier: Apache-2.0
"""Publishing at changes, at a limited rate, always with the last change."""

from __future__ import annotations

import time
from collections.abc import Callable

from rclpy.node import Node

from quadtree_lss.onboard.nodes.executor import steady_timer

WAIT_FRACTION = 0.6
"""How long after it was due the next change is waited for, in intervals between changes."""


class ChangePublisher:
    """Calls ``publish`` after changes, on average at most ``rate`` times a second.

    Of changes that come regularly, the one nearest to the due time is published as it comes, rather
    than an older one at that time. Whatever no further change follows is published by a timer, on a
    steady clock: the last state goes out even if ``/clock`` has stopped. Without changes there is
    no timer. What changes while one is published follows by the timer, too: the node hears others
    in between.
    """

    def __init__(self, node: Node, rate: float, publish: Callable[[], None]) -> None:
        self._period_ns = round(1e9 / rate)
        self._publish = publish
        self._due_ns = self._changed_ns = 0
        self._at_work = False
        self._timer = steady_timer(node, 1.0 / rate, self._send)
        self._timer.cancel()

    def changed(self) -> None:
        """The state changed: send it now, with the next change, or soon after it was due."""
        now_ns = time.monotonic_ns()
        interval_ns = min(now_ns - self._changed_ns, self._period_ns)
        self._changed_ns = now_ns
        wait_ns = self._due_ns - now_ns
        soon = wait_ns <= interval_ns // 2
        if soon and not self._at_work:
            self._send()
        elif self._timer.is_canceled():
            self._timer.timer_period_ns = (
                1 if soon else wait_ns + round(WAIT_FRACTION * interval_ns)
            )
            self._timer.reset()

    def now(self) -> None:
        """The state changed, and must go out whatever the rate."""
        self._due_ns = min(self._due_ns, time.monotonic_ns())
        self._send()

    def _send(self) -> None:
        self._timer.cancel()
        # Keep the publishing phase after a late send.
        now_ns = time.monotonic_ns()
        in_step = now_ns - self._due_ns < self._period_ns
        self._due_ns = (self._due_ns if in_step else now_ns) + self._period_ns
        self._at_work = True
        try:
            self._publish()
        finally:
            self._at_work = False


class MapStamps:
    """No two maps in a row have the same stamp: the two messages of a map are matched by it.

    After a late scan or the loading of a file a map may differ from the last one while its newest
    scan is the same: it is a nanosecond later then. Only the empty map has stamp 0.
    ``content_changed``: set it whenever the map is another than the one published last.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """The map is empty."""
        self.content_changed = False
        self._newest_ns = self._last_ns = 0

    def next(self, newest_ns: int) -> int:
        """Stamp of the next publication of a map whose newest scan has this stamp."""
        stamp_ns = self._last_ns if newest_ns == self._newest_ns else newest_ns
        if self.content_changed and stamp_ns == self._last_ns:
            stamp_ns += 1
        self.content_changed = False
        self._newest_ns, self._last_ns = newest_ns, stamp_ns
        return stamp_ns
