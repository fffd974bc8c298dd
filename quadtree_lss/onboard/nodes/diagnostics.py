# SPDX-License-Identifier: Apache-2.0
"""State of a node on ``/diagnostics``: ages, rates, durations and counted problems."""

from __future__ import annotations

import math
import time
import traceback
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.impl.rcutils_logger import RcutilsLogger

from quadtree_lss.onboard.config.settings import DiagnosticsConfig
from quadtree_lss.onboard.errors import one_line


class Problems:
    """Count problems by reason (``counts``), and log at most one per reason and ``interval``, s.
    ``latest``: text of the last one."""

    def __init__(self, logger: RcutilsLogger, interval: float = 5.0) -> None:
        self.counts: Counter[str] = Counter()
        self.latest = ""
        self._logger, self._interval = logger, interval
        self._logged: dict[str, tuple[float, int]] = {}

    def report(self, reason: str, text: str, number: int = 1) -> None:
        """Count ``number`` problems, and log the text unless the reason was logged recently."""
        self.counts[reason] += number
        self.latest = text = one_line(text)
        now = time.monotonic()
        logged_at, logged_count = self._logged.get(reason, (-self._interval, 0))
        if now - logged_at < self._interval:
            return
        more = self.counts[reason] - logged_count - number
        suffix = f" ({more} more of this kind since the last such line)" if more else ""
        self._logger.warning(text + suffix)
        self._logged[reason] = (now, self.counts[reason])


def failure(what: str, error: Exception, logger: RcutilsLogger) -> str:
    """Log the traceback of an unexpected error, and return one line that describes it."""
    logger.warning("".join(traceback.format_exception(error)))
    return f"{what} failed: {one_line(repr(error), 200)}"


class Arrivals:
    """Number, rate and age of the messages of one topic."""

    def __init__(self) -> None:
        self.count = 0
        self._last = self._rate_time = time.monotonic()
        self._rate_count = 0

    def add(self, arrival: float | None = None) -> None:
        """Count a message; ``arrival``: time of the monotonic clock, s, by default the present."""
        self.count += 1
        self._last = time.monotonic() if arrival is None else arrival

    def age(self) -> float:
        """Return the time since the last message, or since the start, s."""
        return time.monotonic() - self._last

    def rate(self) -> float:
        """Return the rate since the last call, Hz."""
        now = time.monotonic()
        rate = (self.count - self._rate_count) / max(now - self._rate_time, 1e-9)
        self._rate_time, self._rate_count = now, self.count
        return rate


class Span(NamedTuple):
    """Mean and worst duration, ms."""

    mean: float
    worst: float


class Durations:
    """Durations since the last `pop_span`; ``last``: the last one, ms."""

    def __init__(self) -> None:
        self.last = 0.0
        self._values: list[float] = []

    def add(self, milliseconds: float) -> None:
        """Add a duration, unless it is unknown (NaN)."""
        if not math.isnan(milliseconds):
            self.last = milliseconds
            self._values.append(milliseconds)

    def pop_span(self) -> Span | None:
        """Return mean and worst since the last call, or None without a duration."""
        values, self._values = self._values, []
        return Span(sum(values) / len(values), max(values)) if values else None


OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class Status:
    """Status of a node: the worst level, texts, and values by key."""

    def __init__(self) -> None:
        self.level = OK
        self.values: dict[str, object] = {}
        self._notes: list[tuple[bytes, str]] = []

    def note(self, level: bytes, text: str) -> None:
        """Add a text with a level."""
        self.level = max(self.level, level)
        self._notes.append((level, text))

    def add(self, values: Mapping[str, object]) -> None:
        """Add values by key; a `Span` becomes two keys, None is left out."""
        for key, value in values.items():
            if isinstance(value, Span):
                self.values[key] = f"{value.mean:.2f}"
                self.values[f"{key}.worst"] = f"{value.worst:.2f}"
            elif value is not None:
                self.values[key] = f"{value:.2f}" if isinstance(value, float) else value

    def check_age(
        self, name: str, topic: str, arrivals: Arrivals, limits: DiagnosticsConfig
    ) -> None:
        """Add age and rate, and a warning or error if the last message is too old."""
        age, count = arrivals.age(), arrivals.count
        self.add({f"{name}.age_s": age, f"{name}.rate_hz": arrivals.rate()})
        self.add({f"{name}.received": count})
        if age > limits.warn_age:
            level = ERROR if age > limits.error_age else WARN
            since = "for" if count else "since the start,"
            self.note(level, f"no {name} on '{topic}' {since} {age:.1f} s")

    def check_delay(self, text: str, delay: Span | None, limits: DiagnosticsConfig) -> None:
        """Add a warning or error, ``text`` and the delay, if the delay is too long or negative."""
        if delay is not None and abs(delay.worst) > 1e3 * limits.warn_age:
            level = ERROR if abs(delay.worst) > 1e3 * limits.error_age else WARN
            self.note(level, f"{text} {1e-3 * delay.worst:.1f} s")

    @property
    def text(self) -> str:
        """Return all texts, the worst level first."""
        ordered = sorted(self._notes, key=lambda note: note[0], reverse=True)
        return "; ".join(text for _, text in ordered)
