# SPDX-License-Identifier: Apache-2.0
"""Rates, ages and durations of what passes through a node, all by the steady clock."""

from __future__ import annotations

import time
from typing import NamedTuple


class Arrivals:
    """Messages of one kind: how many, how often, and how long ago the last one came.

    Attributes:
        count: Number since the start.
    """

    def __init__(self) -> None:
        self.count = 0
        self._last = self._looked = time.monotonic()
        self._counted = 0

    @staticmethod
    def now() -> float:
        """Present time, s, as `add` takes it."""
        return time.monotonic()

    def add(self, at: float | None = None) -> None:
        """One came just now, or at that time."""
        self.count += 1
        self._last = time.monotonic() if at is None else at

    def age(self) -> float:
        """Seconds since the last one, or since the start if none came."""
        return time.monotonic() - self._last

    def rate(self) -> float:
        """Number per second since this was last asked, Hz."""
        now = time.monotonic()
        rate = (self.count - self._counted) / max(now - self._looked, 1e-9)
        self._looked, self._counted = now, self.count
        return rate


class Span(NamedTuple):
    """Mean and worst duration, ms."""

    mean: float
    worst: float

    def __str__(self) -> str:
        return f"{self.mean:.1f} (worst {self.worst:.1f})"


class Durations:
    """Durations since they were last asked for.

    Attributes:
        last: The last one, ms.
    """

    def __init__(self) -> None:
        self.last = 0.0
        self._sum = self._worst = 0.0
        self._count = 0

    def add(self, milliseconds: float) -> None:
        """One more."""
        self.last = milliseconds
        self._worst = milliseconds if self._count == 0 else max(self._worst, milliseconds)
        self._sum += milliseconds
        self._count += 1

    def take(self) -> Span | None:
        """Mean and worst since the last call, None if there were none."""
        if not self._count:
            return None
        span = Span(self._sum / self._count, self._worst)
        self._sum, self._count = 0.0, 0
        return span
