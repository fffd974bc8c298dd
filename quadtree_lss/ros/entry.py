# SPDX-License-Identifier: Apache-2.0
"""The nodes' console scripts. Signals are heard before anything that takes long is imported."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from importlib import import_module
from types import FrameType

from quadtree_lss.errors import QuadtreeLssError

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopOnSignal:
    """Remembers SIGINT, SIGTERM and SIGHUP, so that a callback in progress ends before the node.

    ROS's own handlers invalidate the context at once, and whatever is being published fails.
    SIGHUP stays ignored if it is, as under ``nohup``.
    """

    def __init__(self) -> None:
        self.asked = False
        for number in SIGNALS:
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self._ask)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked = True


_early: list[StopOnSignal] = []


def stop_on_signal() -> StopOnSignal:
    """What the process's console script began with, once; else a new one."""
    return _early.pop() if _early else StopOnSignal()


def mapping_node() -> int:
    """Console script ``mapping_node``."""
    return _run("mapping_node")


def lss_node() -> int:
    """Console script ``lss_node``."""
    return _run("lss_node")


def _run(name: str) -> int:
    _early.append(StopOnSignal())
    try:
        main: Callable[[], int] = import_module(f"quadtree_lss.ros.{name}").main
    except QuadtreeLssError as error:  # the core is not compiled, or of other sources
        print(f"error: {error}", file=sys.stderr)
        return 1
    return main()
