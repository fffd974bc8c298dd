# SPDX-License-Identifier: Apache-2.0
"""The time of a bag that is being played: it runs at a rate, is published, and can be paused by
services and by a key."""

from __future__ import annotations

import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from quadtree_lss.onboard.nodes.qos import stream
from quadtree_lss.onboard.nodes.ros_messages import time_message

SECOND_NS = 1_000_000_000
PERIOD_S = 0.02
"""Between two messages on ``/clock``, and two looks at services and keyboard."""
PAUSE_PATIENCE_S = 1.0
"""How long a pause waits for a moment at which it harms nothing."""


class PlayTime:
    """Waits for the time of each message; serves ``~/pause``, ``~/resume``, ``~/toggle_paused``.

    It spins the ``node`` that owns these. ``rate`` is bag seconds per second; the time goes out on
    ``/clock``, standing still while paused. ``pressed`` gives the keys pressed since the last call:
    a space toggles.
    """

    def __init__(self, node: Node, rate: float, pressed: Callable[[], str]) -> None:
        self.paused = False
        self._rate = rate
        self._pressed = pressed
        self._asked: float | None = None  # since when a pause is wanted, steady clock
        self._now_ns: int | None = None
        self._looked = 0.0
        self._clock = node.create_publisher(Clock, "/clock", stream(10, reliable=True))
        for name, wanted in (("pause", True), ("resume", False), ("toggle_paused", None)):
            node.create_service(Trigger, f"~/{name}", partial(self._serve, wanted))
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._last = time.monotonic()

    def wait_until(self, bag_ns: int, *, may_pause: bool = True) -> None:
        """Returns when it is time for the message of ``bag_ns``. ``may_pause``: False if a pause
        here would harm: it then comes at the next call that may, or after `PAUSE_PATIENCE_S`."""
        if self._now_ns is None:
            self._now_ns, self._last = bag_ns, time.monotonic()
        while True:
            now = time.monotonic()
            patience_ended = self._asked is not None and now - self._asked > PAUSE_PATIENCE_S
            self.paused = self._asked is not None and (may_pause or patience_ended)
            if not self.paused:
                self._now_ns += round((now - self._last) * self._rate * SECOND_NS)
            self._last = now
            left = (bag_ns - self._now_ns) / (self._rate * SECOND_NS)
            self._clock.publish(Clock(clock=time_message(min(self._now_ns, bag_ns))))
            if left <= 0.0 and not self.paused:
                if now - self._looked > PERIOD_S:
                    self._look(0.0)
                    continue
                return
            self._look(PERIOD_S if self.paused else min(left, PERIOD_S))

    def shutdown(self) -> None:
        self._executor.shutdown()

    def _look(self, wait: float) -> None:
        self._executor.spin_once(timeout_sec=wait)
        self._looked = time.monotonic()
        for _ in range(self._pressed().count(" ")):
            self._ask(None)

    def _ask(self, wanted: bool | None) -> None:
        """Pause (True), go on (False), or the other of the two (None)."""
        if wanted is None or wanted == (self._asked is None):
            self._asked = time.monotonic() if self._asked is None else None

    def _serve(
        self, wanted: bool | None, _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        self._ask(wanted)
        response.success = True
        response.message = "playing" if self._asked is None else "paused"
        return response


@contextmanager
def keys_pressed() -> Iterator[Callable[[], str]]:
    """Gives what was pressed in the terminal since it was asked last, not at the end of a line.

    Without a terminal, or in the background of one, no key is ever pressed. Ctrl-C and Ctrl-Z do
    what they always do.
    """
    ours = sys.stdin is not None and not sys.stdin.closed and sys.stdin.isatty()
    with suppress(OSError):  # not the terminal that controls this process: it has no background
        ours = ours and os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    if not ours:
        yield lambda: ""
        return
    terminal, gone = sys.stdin.fileno(), False

    def pressed() -> str:
        nonlocal gone
        if gone or not select.select([terminal], [], [], 0.0)[0]:
            return ""
        content = os.read(terminal, 1024)
        gone = not content
        return content.decode(errors="replace")

    before = termios.tcgetattr(terminal)
    tty.setcbreak(terminal)
    try:
        yield pressed
    finally:
        if not gone:
            termios.tcsetattr(terminal, termios.TCSADRAIN, before)
