# SPDX-License-Identifier: Apache-2.0
"""What goes wrong, counted by reason and told to the log without flooding it."""

from __future__ import annotations

import time
from collections import Counter
from typing import Protocol


class Logger(Protocol):
    """The part of a ROS logger that is used here."""

    def warning(self, message: str) -> object: ...


class Problems:
    """Counts by reason; of each reason the first goes to the log, then one per interval.

    Args:
        logger: Where the lines go.
        interval: Least time between two lines of one reason, s.

    Attributes:
        counts: Number by reason since the start.
        latest: Text of the last one.
    """

    def __init__(self, logger: Logger, interval: float = 5.0) -> None:
        self.counts: Counter[str] = Counter()
        self.latest = ""
        self._logger = logger
        self._interval = interval
        self._told: dict[str, tuple[float, int]] = {}

    def report(self, reason: str, text: str, number: int = 1) -> None:
        """Count ``number``, and say so if this reason was not heard of lately."""
        self.counts[reason] += number
        self.latest = text
        now = time.monotonic()
        told_at, told_count = self._told.get(reason, (-self._interval, 0))
        if now - told_at < self._interval:
            return
        more = self.counts[reason] - told_count - number
        suffix = f" ({more} more of this kind since the last such line)" if more else ""
        self._logger.warning(text + suffix)
        self._told[reason] = (now, self.counts[reason])
