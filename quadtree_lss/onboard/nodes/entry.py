# SPDX-License-Identifier: Apache-2.0
"""Console scripts of the nodes. They install signal handlers before the slow imports."""

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

INTERRUPT_AFTER_S = 3.0
"""Time after the first signal in which further ones are ignored, because a terminal and ``launch``
may both send one. After it, a signal interrupts the callback in progress."""

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopOnSignal:
    """Record signals, so that a callback in progress completes before the exit; ROS's own handlers
    let publishing in progress fail. SIGHUP stays ignored if it was, as under ``nohup``."""

    def __init__(self) -> None:
        self.requested = False
        self._first = 0.0
        self._interrupts = False
        for number in SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._on_signal)

    @contextlib.contextmanager
    def interrupting(self) -> Iterator[None]:
        """Raise KeyboardInterrupt within this context on a signal after `INTERRUPT_AFTER_S`."""
        self._interrupts = True
        try:
            yield
        finally:
            self._interrupts = False

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if not self.requested:
            self.requested, self._first = True, now
        elif self._interrupts and now - self._first >= INTERRUPT_AFTER_S:
            raise KeyboardInterrupt


class Waiting:
    """Log what a node waits for (``what``, empty for nothing) after five seconds, then after twice
    as long each time; to standard error until ``log`` is set."""

    def __init__(self, name: str) -> None:
        self.what, self._name = "its modules", name
        self.log: Callable[[str], object] = self._print
        self._reported, self._period = time.monotonic(), 5.0

    def watch(self) -> None:
        """Log until the process ends, in a thread of its own."""
        while True:
            time.sleep(0.5)
            now = time.monotonic()
            if self.what and now - self._reported >= self._period:
                self.log(f"waiting for {self.what}")
                self._reported, self._period = now, 2.0 * self._period

    def _print(self, line: str) -> None:
        head = f"[WARN] [{time.time():.9f}] [{self._name}]"
        print(f"{head}: starting, {line}", file=sys.stderr, flush=True)


_waiting: list[Waiting] = []


def set_waiting_for(what: str, log: Callable[[str], object] | None = None) -> None:
    """Set what this process waits for, empty for nothing, and optionally the function that logs."""
    for waiting in _waiting:
        waiting.what, waiting.log = what, log or waiting.log


_early: list[StopOnSignal] = []


def stop_on_signal() -> StopOnSignal:
    """Return the signal handler of the console script, or install one."""
    return _early.pop() if _early else StopOnSignal()


def _run(name: str) -> int:
    _early.append(StopOnSignal())
    _waiting.append(Waiting(name))
    threading.Thread(target=_waiting[-1].watch, daemon=True).start()
    try:
        main: Callable[[], int] = import_module(f"quadtree_lss.onboard.nodes.{name}").main
    except (QuadtreeLssError, ImportError) as error:
        # The core is not compiled from these sources, or a ROS package is missing.
        print(f"error: {name} cannot start: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    try:
        return main()
    finally:  # the interpreter restores default handlers, with which a signal would kill it
        set_waiting_for("")
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN)


#: The console scripts.
mapping_node = partial(_run, "mapping_node")
lss_node = partial(_run, "lss_node")
autopilot_node = partial(_run, "autopilot_node")
