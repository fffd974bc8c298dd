# SPDX-License-Identifier: Apache-2.0
"""The nodes' console scripts. Signals are heard before anything that takes long is imported."""

from __future__ import annotations

import signal
from types import FrameType

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
    _early.append(StopOnSignal())
    from quadtree_lss.ros.mapping_node import main

    return main()


def lss_node() -> int:
    """Console script ``lss_node``."""
    _early.append(StopOnSignal())
    from quadtree_lss.ros.lss_node import main

    return main()
