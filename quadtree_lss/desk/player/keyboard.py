# SPDX-License-Identifier: Apache-2.0
"""Keys pressed in a terminal, one by one."""

from __future__ import annotations

import os
import select
import sys
import termios
import tty
from types import TracebackType
from typing import Any


class Keyboard:
    """Context manager that reads keys as they are pressed, not at the end of a line.

    Without a terminal, or in the background of one, no key is ever pressed. Ctrl-C and Ctrl-Z do
    what they always do.
    """

    def __init__(self) -> None:
        self._terminal: int | None = None
        self._before: list[Any] = []

    def __enter__(self) -> Keyboard:
        if sys.stdin is None or sys.stdin.closed or not sys.stdin.isatty():
            return self
        terminal = sys.stdin.fileno()
        if _in_foreground(terminal):
            self._before = termios.tcgetattr(terminal)
            tty.setcbreak(terminal)
            self._terminal = terminal
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._terminal is not None:
            termios.tcsetattr(self._terminal, termios.TCSADRAIN, self._before)
            self._terminal = None

    def pressed(self) -> str:
        """What was pressed since the last call; never waits."""
        if self._terminal is None or not select.select([self._terminal], [], [], 0.0)[0]:
            return ""
        content = os.read(self._terminal, 1024)
        if not content:  # the terminal is gone
            self._terminal = None
        return content.decode(errors="replace")


def _in_foreground(terminal: int) -> bool:
    try:
        return os.tcgetpgrp(terminal) == os.getpgrp()
    except OSError:  # not the terminal that controls this process: it has no background
        return True
