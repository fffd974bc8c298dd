# SPDX-License-Identifier: Apache-2.0
"""Files of recorded messages: index, order of reading, and losses.

A damaged file is read up to the first damage, and beyond it as far as the file's index reaches.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import ReaderError

from quadtree_lss.desk.bags.compression import DamagedError

YEAR_S = 365 * 24 * 3600.0
JITTER_NS = 10**8
"""Messages of one topic may be out of order by this time although the clock is steady."""
LAST_NS = 2**63 - 1
"""Latest possible time of reception."""
INDEX = np.dtype([("time_ns", "i8"), ("channel", "i8"), ("position", "i8"), ("offset", "i8")])
"""A message: time of reception, channel, position of its chunk or row, offset in the chunk."""
DAMAGE = (DamagedError, ReaderError, KeyError, ValueError, struct.error)
"""Errors raised when damaged bytes are parsed."""


class RawMessage(NamedTuple):
    """A message as recorded: topic, time of reception, serialised bytes."""

    topic: str
    received_ns: int
    raw: bytes


Row = tuple[int, int, int, int]
"""The fields of `INDEX` of one message."""


class RecordedFile(ABC):
    """A file of messages. ``topics``: topic and type by channel; ``index``: (M,) `INDEX` in order
    of reading; ``counts``: messages by topic; ``notes``: lines for the user; ``fault``: damage of
    the whole file; ``expected``: number of messages that the file declares, or None."""

    ros1 = False
    unit = "byte"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: dict[int, tuple[str, str]] = {}
        self.notes: list[str] = []
        self.fault = ""
        self.expected: int | None = None
        self._damage: dict[int, str] = {}
        self._unread: set[tuple[int, int]] = set()
        self._size = path.stat().st_size
        self._file = path.open("rb")
        rows = [row for row in self._rows() if row[1] in self.topics]
        self.index = np.array(rows, INDEX)
        times = self.index["time_ns"]
        self._replaced = replace_impossible(times)
        self.start_ns, self.end_ns = int(times.min(initial=LAST_NS)), int(times.max(initial=0))
        self.counts = Counter(self.topics[row[1]][0] for row in rows)
        by_channel = (times[self.index["channel"] == channel] for channel in self.topics)
        if any((np.diff(channel) < -JITTER_NS).any() for channel in by_channel):
            self.notes.append(f"{path.name}: the recorder's clock stepped back")
        else:
            self.index = self.index[np.argsort(times, kind="stable")]

    @abstractmethod
    def _rows(self) -> Iterable[Row]:
        """Find topics and messages; return rows of `INDEX` in the order of the file."""

    @abstractmethod
    def _load(self, position: int) -> Iterator[tuple[Row, bytes]]:
        """Read the messages of a chunk or row. Raises one of `DAMAGE`."""

    def close(self) -> None:
        self._file.close()

    @property
    def losses(self) -> list[str]:
        """One line if a part could not be read so far."""
        parts = [self.fault] if self.fault else []
        if self._damage:
            position, more = min(self._damage), len(self._damage) - 1
            parts.append(f"{self._damage[position]} at {self.unit} {position}")
            parts[-1] += f" and {more} positions more" if more else ""
        if self._replaced:
            parts.append(f"{self._replaced} impossible times of reception replaced")
        lost = len(self._unread) + max((self.expected or 0) - len(self.index), 0)
        if lost or parts and self.expected:
            parts.append(f"{lost} of {self.expected or 'an unknown number of'} messages lost")
        return [f"{self.path.name}: {', '.join(parts)}"] if parts else []

    def messages(
        self, topics: Collection[str], start_ns: int, stop_ns: int
    ) -> Iterator[RawMessage]:
        """Yield messages with start_ns <= time of reception < stop_ns, by time, or in the order of
        the file if the recorder's clock stepped back."""
        wanted = [channel for channel, (name, _) in self.topics.items() if name in topics]
        times = self.index["time_ns"]
        inside = (times >= start_ns) & (times < stop_ns)
        chosen = self.index[inside & np.isin(self.index["channel"], wanted)]
        remaining = Counter(chosen["position"].tolist())
        loaded: dict[int, dict[tuple[int, int], bytes]] = {}
        for time_ns, channel, position, offset in chosen.tolist():
            if position not in loaded:
                loaded[position] = {(row[3], row[1]): raw for row, raw in self._messages(position)}
            raw = loaded[position].get((offset, channel))
            remaining[position] -= 1
            if not remaining[position]:
                del loaded[position]
            if raw is None:
                self._unread.add((position, offset))
            else:
                yield RawMessage(self.topics[channel][0], time_ns, raw)

    def _messages(self, position: int) -> list[tuple[Row, bytes]]:
        """Return the messages of a chunk or row up to the first damage, which is recorded."""
        found: list[tuple[Row, bytes]] = []
        try:
            found.extend(self._load(position))
        except DAMAGE as error:
            self._damage.setdefault(position, str(error))
        return found


def replace_impossible(times: NDArray[np.int64]) -> int:
    """Replace times more than a year from the median by the previous ones, in place; return their
    number."""
    bad = np.abs(times / 1e9 - np.median(times) / 1e9) > YEAR_S if len(times) else np.zeros(0, bool)
    good = np.flatnonzero(~bad)
    times[bad] = times[good[np.maximum(np.searchsorted(good, np.flatnonzero(bad)) - 1, 0)]]
    return int(np.count_nonzero(bad))
