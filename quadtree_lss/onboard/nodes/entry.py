# SPDX-License-Identifier: Apache-2.0
"""The nodes' console scripts. Signals are heard before anything that takes long is imported."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from importlib import import_module
from types import FrameType

from quadtree_lss.onboard.errors import QuadtreeLssError

PATIENCE_S = 3.0
"""So long a callback may go on; a terminal and ``launch`` may both send the first signal."""

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopOnSignal:
    """Remembers SIGINT, SIGTERM and SIGHUP, so that a callback in progress ends before the node.

    ROS's own handlers invalidate the context at once, and whatever is being published fails.
    SIGHUP stays ignored if it is, as under ``nohup``. Who asks again after `PATIENCE_S`, as
    ``launch`` does, breaks the callback off.
    """

    def __init__(self) -> None:
        self.asked = False
        self._first = 0.0
        self._breaks = False
        for number in SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._ask)

    @contextlib.contextmanager
    def breaking(self) -> Iterator[None]:
        """Within it, asking again raises KeyboardInterrupt; what was at work is then half done."""
        self._breaks = True
        try:
            yield
        finally:
            self._breaks = False

    def _ask(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if not self.asked:
            self.asked, self._first = True, now
        elif self._breaks and now - self._first >= PATIENCE_S:
            raise KeyboardInterrupt


class Starting:
    """Says what a node that starts is at, as long as it has no log of its own: after five seconds,
    then each time after twice as long.

    Args:
        name: Of the node.

    Attributes:
        at: What it waits for at present.
    """

    def __init__(self, name: str) -> None:
        self.at, self._name = "its modules", name
        self._over = threading.Event()
        threading.Thread(target=self._say, daemon=True).start()

    def _say(self) -> None:
        period = 5.0
        while not self._over.wait(period):
            head = f"[WARN] [{time.time():.9f}] [{self._name}]"
            print(f"{head}: starting, waiting for {self.at}", file=sys.stderr, flush=True)
            period *= 2.0

    def done(self) -> None:
        """The node speaks for itself."""
        self._over.set()


_starting: list[Starting] = []


def waits_for(what: str) -> None:
    """What the node of this process is at while it starts; empty once it has."""
    for starting in _starting:
        starting.at = what
        if not what:
            starting.done()


_early: list[StopOnSignal] = []


def stop_on_signal() -> StopOnSignal:
    """What the process's console script began with, once; else a new one."""
    return _early.pop() if _early else StopOnSignal()


def _run(name: str) -> int:
    _early.append(StopOnSignal())
    _starting.append(Starting(name))
    try:
        main: Callable[[], int] = import_module(f"quadtree_lss.onboard.nodes.{name}").main
    except QuadtreeLssError as error:  # the core is not compiled, or of other sources
        print(f"error: {error}", file=sys.stderr)
        return 1
    try:
        return main()
    finally:  # Python ends, and gives signals back that would kill it on its way
        waits_for("")
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)


#: The console scripts.
mapping_node = partial(_run, "mapping_node")
lss_node = partial(_run, "lss_node")
autopilot_node = partial(_run, "autopilot_node")
