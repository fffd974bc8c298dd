# SPDX-License-Identifier: Apache-2.0
"""A file of recorded messages in whatever state: an index of them, their order, what was lost.

Whole files are indexed by what they say of themselves; of a damaged one each chunk is opened for
that. A damaged chunk costs no more than itself.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadtree_lss.desk.bags.compression import MOST_BYTES, DamagedError, plain_message, unpack
from quadtree_lss.desk.bags.message_types import GIMBAL_TYPE, POSE_TYPES, SCAN_TYPES

HOUR_NS = 3600 * 10**9
YEAR_NS = 365 * 24 * HOUR_NS
JITTER_NS = 10**8
"""By so much messages of a topic overtake each other though the clock does not step."""
LAST_NS = 2**63 - 1
"""Times of reception beyond are none."""
INDEX = np.dtype([("time_ns", "i8"), ("offset", "i8"), ("channel", "i8"), ("chunk", "i4")])
"""A message: time of reception, and its place in a chunk (or number of its row)."""


class RawMessage(NamedTuple):
    """A message as recorded: topic, time of reception, serialised bytes."""

    topic: str
    received_ns: int
    raw: bytes


class Record(NamedTuple):
    """A message of a chunk: its place there, number of its channel, time, serialised bytes."""

    offset: int
    channel: int
    time_ns: int
    raw: bytes


class RecordedFile(ABC):
    """A file of messages: topic and type by number of the channel; (M,) `INDEX` of the messages in
    the order of the file, and the ``order`` in which they are read; ``notes`` to know, a line each;
    ``disorder`` says that the two orders differ, or is empty."""

    ros1 = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: dict[int, tuple[str, str]] = {}
        self.index = np.zeros(0, INDEX)
        self.notes: list[str] = []
        self.disorder = ""
        self._open()
        self.impossible_times = mend_times(self.index["time_ns"])
        self.order = self._order()

    @abstractmethod
    def _open(self) -> None:
        """Finds topics and messages; the file stays open."""

    @abstractmethod
    def close(self) -> None:
        """Ends reading."""

    @property
    @abstractmethod
    def losses(self) -> list[str]:
        """What could not be read, up to now, one line each."""

    @abstractmethod
    def _contents(self, places: NDArray[np.intp]) -> Iterator[tuple[int, bytes]]:
        """Place in the index and serialised bytes of those messages that can be read."""

    def _disorder(self) -> str:
        """What is lost of the file's own order where that is not the order of the times."""
        return ""

    @property
    def counts(self) -> dict[str, int]:
        """Messages by topic."""
        channels, numbers = np.unique(self.index["channel"], return_counts=True)
        counts: Counter[str] = Counter()
        for channel, number in zip(channels.tolist(), numbers.tolist(), strict=True):
            counts[self.topics[channel][0]] += number
        return dict(counts)

    @property
    def start_ns(self) -> int:
        return int(self.index["time_ns"].min(initial=LAST_NS))

    @property
    def end_ns(self) -> int:
        return int(self.index["time_ns"].max(initial=0))

    def messages(
        self, topics: Collection[str] | None, start_ns: int = 0, stop_ns: int = LAST_NS
    ) -> Iterator[RawMessage]:
        """Messages with start_ns <= time of reception < stop_ns; None for all topics.

        In the order of their times or, if a clock stepped back, in that of the file.
        """
        wanted = [c for c, (name, _) in self.topics.items() if topics is None or name in topics]
        times = self.index["time_ns"]
        chosen = np.isin(self.index["channel"], wanted) & (times >= start_ns) & (times < stop_ns)
        for place, raw in self._contents(self.order[chosen[self.order]]):
            entry = self.index[place]
            yield RawMessage(self.topics[int(entry["channel"])][0], int(entry["time_ns"]), raw)

    def _order(self) -> NDArray[np.intp]:
        """By the times, unless topics' times step back and their messages' stamps do so less in
        the order of the file: then the recorder's clock stepped."""
        by_time = np.argsort(self.index["time_ns"], kind="stable")
        in_file = np.arange(len(by_time))
        if self._steps_back(self.index["time_ns"], in_file):
            stamps = self._stamps()
            if self._steps_back(stamps, by_time) > self._steps_back(stamps, in_file):
                self.notes.append(f"{self.path.name}: the recorder's clock stepped back")
                return in_file
            self.disorder = self._disorder()
        return by_time

    def _steps_back(self, times: NDArray[np.int64], order: NDArray[np.intp]) -> int:
        """How often known times of a topic go back by more than messages overtake each other."""
        times, channels = times[order], self.index["channel"][order]
        series = (times[(channels == channel) & (times >= 0)] for channel in self.topics)
        return sum(int(np.count_nonzero(np.diff(one) < -JITTER_NS)) for one in series)

    def _stamps(self) -> NDArray[np.int64]:
        """(M,) stamps in the messages' headers, -1 where there is none that we know."""
        stamped = (*SCAN_TYPES, *POSE_TYPES, GIMBAL_TYPE)
        known = [channel for channel, (_, kind) in self.topics.items() if kind in stamped]
        out = np.full(len(self.index), -1)
        places = np.flatnonzero(np.isin(self.index["channel"], known))
        for place, raw in self._contents(places):
            out[place] = stamp_of(raw, self.ros1)
        return out


@dataclass
class Chunk:
    """A chunk of messages in a file: where its record's content begins, its length, and the bytes
    of it that are ``there``; ``entries`` are `INDEX` of its messages, as far as the file tells,
    ``first`` and ``count`` their place in the file's index."""

    place: int
    length: int
    there: int
    entries: list[NDArray[Any]] = field(default_factory=list)
    first: int = 0
    count: int = 0


class ChunkedFile(RecordedFile):
    """A file of chunks, such as mcap and ROS 1 bags: those found, in the order of the file; how
    many messages its end tells of, None if that cannot be read; what is wrong and how many messages
    are lost, by the byte; and that the file ends early (``cut``), or empty."""

    def _open(self) -> None:
        self.chunks: list[Chunk] = []
        self.expected: int | None = None
        self.damage: dict[int, str] = {}
        self.lost: dict[int, int] = {}
        self.cut = ""
        self._size = self.path.stat().st_size
        self._file = self.path.open("rb")
        try:
            self._walk()
            self._make_index()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._file.close()

    @abstractmethod
    def _walk(self) -> None:
        """Finds chunks, channels and what is expected, without opening a chunk."""

    @abstractmethod
    def _scan(self, chunk: Chunk) -> Iterator[Record]:
        """Messages of a chunk in their order; channels that it declares are noted. Raises
        `DamagedError`: it is damaged; what came before is sound."""

    def _read(self, place: int, length: int) -> bytes:
        self._file.seek(place)
        return self._file.read(length)

    def _unpack(self, chunk: Chunk, compression: str, begin: int, size: int) -> bytes:
        """Content of a chunk of ``size`` bytes whose data begin at a byte of the file; of a cut
        chunk what is there."""
        if chunk.length > MOST_BYTES:
            raise DamagedError(f"chunk of {chunk.length} bytes, {MOST_BYTES} is the most,")
        data = unpack(compression, self._read(begin, chunk.place + chunk.there - begin), size)
        if chunk.there == chunk.length and len(data) != size:
            raise DamagedError(f"chunk of {len(data)} bytes instead of {size}")
        return data

    @property
    def losses(self) -> list[str]:
        """One line if something could not be read, up to now."""
        faults = [f"{reason} at byte {place}" for place, reason in sorted(self.damage.items())]
        if len(faults) > 1:
            faults = [f"{len(faults)} places damaged, the first: {faults[0]}"]
        if self.impossible_times:
            faults.append(f"{self.impossible_times} impossible times of reception, mended")
        parts = [part for part in (self.cut, *faults, self.disorder) if part]
        lost = sum(self.lost.values())
        if self.expected is not None:
            lost += max(self.expected - len(self.index), 0)
        if lost or self.damage or self.cut:
            if self.lost:
                parts.append(f"{len(self.lost)} of {len(self.chunks)} chunks damaged")
            if self.expected is not None:
                parts.append(f"{lost} of {self.expected} messages lost")
            else:
                parts.append(f"at least {lost} messages lost: how many there were is not known")
        return [f"{self.path.name}: {', '.join(parts)}"] if parts else []

    def _make_index(self) -> None:
        """Opens the chunks that the file does not tell of, or whose channels nobody knows; those
        of a damaged file all, for what it tells may be damaged too."""
        sound = not self.damage and not self.cut
        pieces, first = [np.zeros(0, INDEX)], 0
        for number, chunk in enumerate(self.chunks):
            told = np.concatenate([np.zeros(0, INDEX), *chunk.entries])
            entries = told[np.argsort(told["offset"], kind="stable")]
            if not (sound and len(told) and set(told["channel"].tolist()) <= self.topics.keys()):
                found = self._records(chunk)
                rows = [(r.time_ns, r.offset, r.channel, 0) for r in found.values()]
                entries = np.array(rows, INDEX)
                if chunk.place in self.damage:
                    # What the file's end says is missing counts already.
                    lost = 0 if self.expected is not None else len(told) - len(entries)
                    self.lost[chunk.place] = max(lost, 0)
            entries = entries[np.isin(entries["channel"], list(self.topics))]
            entries["chunk"] = number
            chunk.first, chunk.count, chunk.entries = first, len(entries), []
            first += len(entries)
            pieces.append(entries)
        self.index = np.concatenate(pieces)

    def _records(self, chunk: Chunk) -> dict[int, Record]:
        """Messages of a chunk by their place in it; what is wrong with it is noted."""
        found = {}
        try:
            found.update((record.offset, record) for record in self._scan(chunk))
        except DamagedError as error:
            self.damage.setdefault(chunk.place, str(error))
        return found

    def _contents(self, places: NDArray[np.intp]) -> Iterator[tuple[int, bytes]]:
        numbers, counts = np.unique(self.index["chunk"][places], return_counts=True)
        left = dict(zip(numbers.tolist(), counts.tolist(), strict=True))
        held: dict[int, dict[int, Record]] = {}
        for place in map(int, places):
            entry = self.index[place]
            number, offset = int(entry["chunk"]), int(entry["offset"])
            if number not in held:
                held[number] = self._checked(self.chunks[number])
            record = held[number].get(offset)
            left[number] -= 1
            if not left[number]:
                del held[number]
            if record is not None:
                yield place, record.raw

    def _checked(self, chunk: Chunk) -> dict[int, Record]:
        """Messages of a chunk that the index has; the others that it has are lost."""
        entries = self.index[chunk.first : chunk.first + chunk.count]
        told = {*zip(entries["offset"].tolist(), entries["channel"].tolist(), strict=True)}
        found = self._records(chunk)
        sound = {at: record for at, record in found.items() if (at, record.channel) in told}
        if len(sound) < chunk.count:
            self.lost[chunk.place] = chunk.count - len(sound)
            self.damage.setdefault(chunk.place, "messages missing in a chunk")
        return sound

    def _disorder(self) -> str:
        times = [self.index["time_ns"][c.first : c.first + c.count] for c in self.chunks]
        starts = [int(own.min()) for own in times if len(own)]
        return "" if starts == sorted(starts) else "chunks out of order, put in that of their times"


def mend_times(times: NDArray[np.int64]) -> int:
    """Takes impossible times of messages one after the other to be their neighbours', in place.

    A time is impossible if it is negative, or lies more than an hour from its neighbours, which
    agree with each other; the first and the last if it lies a year away. Returns how many were.
    """
    bad = times < 0
    if len(times) >= 3:
        exact = times.astype(np.float64)
        step, over = np.abs(np.diff(exact)), np.abs(exact[2:] - exact[:-2])
        bad[1:-1] |= (step[:-1] > HOUR_NS) & (step[1:] > HOUR_NS) & (over < HOUR_NS)
        bad[0] |= step[0] > YEAR_NS and step[1] < HOUR_NS
        bad[-1] |= step[-1] > YEAR_NS and step[-2] < HOUR_NS
    for k in np.flatnonzero(bad):
        times[k] = times[k - 1] if k else max(int(times[np.argmin(bad)]), 0)
    return int(np.count_nonzero(bad))


def as_times(values: ArrayLike) -> NDArray[np.int64]:
    """Unsigned times; those beyond the last possible one become that."""
    return np.minimum(np.asarray(values, np.uint64), np.uint64(LAST_NS)).astype(np.int64)


def stamp_of(raw: bytes, ros1: bool) -> int:
    """Stamp of a serialised message that begins with its header, ns; -1 if it is cut short."""
    try:
        raw = plain_message(raw)
        big = not ros1 and raw[1] == 0
        seconds, nanoseconds = struct.unpack_from(">II" if big else "<II", raw, 4)
    except (DamagedError, struct.error, IndexError):
        return -1
    return int(seconds) * 10**9 + int(nanoseconds)
