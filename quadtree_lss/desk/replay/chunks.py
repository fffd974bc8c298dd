# SPDX-License-Identifier: Apache-2.0
"""Files that hold messages in chunks, such as mcap and ROS 1 bags: order, and what was lost.

A damaged chunk costs no more than itself. The index tells how many messages that were; without one
a chunk is opened to be counted.
"""

from __future__ import annotations

import heapq
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from quadtree_lss.desk.replay.records import (
    Extent,
    RawMessage,
    Times,
    mended,
    stamp_of,
    steps_back,
)
from quadtree_lss.desk.replay.unpack import DamagedError


class Record(NamedTuple):
    """A message of a chunk: number of its channel, time of reception, serialised bytes."""

    channel: int
    time_ns: int
    raw: bytes


@dataclass
class Chunk:
    """A chunk of a file: where its record's content begins, and its length.

    Attributes:
        there: Bytes of it that the file has.
        times: Times of reception by channel, in the order of the file.
    """

    place: int
    length: int
    there: int
    times: dict[int, Times] = field(default_factory=dict)

    @property
    def start_ns(self) -> int:
        """Least time of reception."""
        return min(int(times.min()) for times in self.times.values())

    @property
    def end_ns(self) -> int:
        """Greatest time of reception."""
        return max(int(times.max()) for times in self.times.values())

    @property
    def count(self) -> int:
        """Messages in it."""
        return sum(map(len, self.times.values()))


class ChunkedFile(ABC):
    """A file of chunks.

    Attributes:
        path: The file.
        topics: Topic and type by number of the channel.
        chunks: Those found, in the order of the file.
        expected: Messages by channel as the file's end says, None if that cannot be read.
        damage: What is wrong, by the byte at which it was found.
        lost: Messages of damaged chunks, by the byte of the chunk.
        cut: That the file ends early, or empty.
        disorder: That the order of the chunks is not that of their times, or empty.
        notes: What to know, one line each.
    """

    ros1 = False

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: dict[int, tuple[str, str]] = {}
        self.chunks: list[Chunk] = []
        self.expected: dict[int, int] | None = None
        self.damage: dict[int, str] = {}
        self.lost: dict[int, int] = {}
        self.cut = self.disorder = ""
        self.notes: list[str] = []
        with open(path, "rb") as self._file:
            self._size = path.stat().st_size
            self._walk()
            self._count()
            self.whole = len(self.chunks)
            self.chunks = [chunk for chunk in self.chunks if chunk.count]
            self._in_time = self._is_in_time()

    @abstractmethod
    def _walk(self) -> None:
        """Find chunks, channels and what is expected, without opening a chunk."""

    @abstractmethod
    def _open(self, chunk: Chunk) -> Iterator[Record]:
        """Messages of a chunk in their order; channels that it declares are noted.

        Raises:
            DamagedError: it is damaged; what came before is sound.
        """

    def extent(self) -> Extent:
        """Topics, numbers of messages and times."""
        counts: Counter[str] = Counter()
        for chunk in self.chunks:
            for channel, times in chunk.times.items():
                if channel in self.topics:
                    counts[self.topics[channel][0]] += len(times)
        start = min((chunk.start_ns for chunk in self.chunks), default=0)
        end = max((chunk.end_ns for chunk in self.chunks), default=0)
        return Extent(dict(self.topics.values()), dict(counts), start, end)

    @property
    def losses(self) -> list[str]:
        """One line if something could not be read, up to now."""
        missing = 0
        if self.expected is not None:
            found = sum(chunk.count for chunk in self.chunks)
            missing = max(sum(self.expected.values()) - found, 0)
        lost = missing + sum(self.lost.values())
        told = [f"{reason} at byte {place}" for place, reason in sorted(self.damage.items())]
        if len(told) > 1:
            told = [f"{len(told)} places damaged, the first: {told[0]}"]
        parts = [part for part in (self.cut, *told, self.disorder) if part]
        if not lost and not self.damage and not self.cut:
            return [f"{self.path.name}: {part}" for part in parts]
        if self.lost:
            parts.append(f"{len(self.lost)} of {self.whole} chunks damaged")
        if self.expected is not None:
            parts.append(f"{lost} of {sum(self.expected.values())} messages lost")
        else:
            parts.append(f"at least {lost} messages lost: how many there were is not known")
        return [f"{self.path.name}: {', '.join(parts)}"]

    def messages(
        self, topics: Collection[str] | None, start_ns: int, stop_ns: int
    ) -> Iterator[RawMessage]:
        """Messages with start_ns <= time of reception < stop_ns; None for all topics.

        In the order of their times or, if a clock stepped back, in that of the file.
        """
        wanted = [
            chunk
            for chunk in self.chunks
            if chunk.start_ns < stop_ns
            and chunk.end_ns >= start_ns
            and (topics is None or any(self._topic(c) in topics for c in chunk.times))
        ]
        with open(self.path, "rb") as self._file:
            stream = self._by_time(wanted) if self._in_time else self._by_place(wanted)
            for record in stream:
                topic = self._topic(record.channel)
                known = topic and (topics is None or topic in topics)
                if known and start_ns <= record.time_ns < stop_ns:
                    yield RawMessage(topic, record.time_ns, record.raw)

    def _topic(self, channel: int) -> str:
        return self.topics.get(channel, ("", ""))[0]

    def _by_place(self, chunks: list[Chunk]) -> Iterator[Record]:
        for chunk in chunks:
            yield from self._content(chunk)

    def _by_time(self, chunks: list[Chunk]) -> Iterator[Record]:
        """Chunks are opened when their time has come; of equal times the first in the file."""
        held: list[tuple[int, int, int, Record]] = []
        for chunk in sorted(chunks, key=lambda chunk: (chunk.start_ns, chunk.place)):
            start_ns = chunk.start_ns
            while held and held[0][0] < start_ns:
                yield heapq.heappop(held)[3]
            records = self._content(chunk)
            if not any(steps_back(times) for times in _by_channel(records).values()):
                records.sort(key=lambda record: record.time_ns)
            latest = 0
            for k, record in enumerate(records):
                latest = max(latest, record.time_ns)
                heapq.heappush(held, (latest, chunk.place, k, record))
        while held:
            yield heapq.heappop(held)[3]

    def _content(self, chunk: Chunk) -> list[Record]:
        """Messages of a chunk in their order; what is wrong with it is noted."""
        found: list[Record] = []
        try:
            found.extend(self._open(chunk))
        except DamagedError as error:
            self.damage.setdefault(chunk.place, str(error))
        times, bad = mended([record.time_ns for record in found])
        if chunk.times:
            there = Counter(record.channel for record in found)
            lost = sum(max(len(own) - there[c], 0) for c, own in chunk.times.items())
            if lost:
                self.lost[chunk.place] = lost
                self.damage.setdefault(chunk.place, "messages missing in a chunk")
            limited = np.clip(times, chunk.start_ns, chunk.end_ns)
            bad, times = bad + int(np.count_nonzero(limited != times)), limited
        if bad:
            self.damage.setdefault(chunk.place, f"{bad} impossible times of reception, mended,")
            pairs = zip(found, times.tolist(), strict=True)
            found = [record._replace(time_ns=time_ns) for record, time_ns in pairs]
        return found

    def _count(self) -> None:
        """Open the chunks that the index does not tell of, or whose channels nobody knows.

        Those of a damaged file all: their index may be cut.
        """
        sound = not self.damage and not self.cut
        for chunk in self.chunks:
            if sound and chunk.times and chunk.times.keys() <= self.topics.keys():
                chunk.times = {c: mended(times)[0] for c, times in chunk.times.items()}
                continue
            indexed, chunk.times = chunk.count, {}
            chunk.times = _by_channel(self._content(chunk))
            if chunk.place in self.damage:
                # What the file's end says is missing counts already.
                known = self.expected is None and indexed > chunk.count
                self.lost[chunk.place] = indexed - chunk.count if known else 0

    def _is_in_time(self) -> bool:
        """Whether the chunks go by their times; else a clock stepped back, and by their place.

        Where some topic's times go back from one chunk to the next, that order counts in which
        the stamps of its messages go back less often.
        """
        if not self._backs(self.chunks, {chunk.place: chunk.times for chunk in self.chunks}):
            return True
        by_time = sorted(self.chunks, key=lambda chunk: chunk.start_ns)
        if by_time != self.chunks:
            stamps = {chunk.place: self._stamps(chunk) for chunk in self.chunks}
            if self._backs(by_time, stamps) <= self._backs(self.chunks, stamps):
                self.disorder = "chunks out of order, put in that of their times"
                return True
        self.notes.append(f"{self.path.name}: the recorder's clock stepped back")
        return False

    def _backs(self, chunks: list[Chunk], times: Mapping[int, Mapping[int, Times]]) -> int:
        """How often times (by place and channel) go back in an order of the chunks."""
        none = np.zeros(0, dtype=np.int64)
        return sum(
            steps_back(np.concatenate([times[chunk.place].get(channel, none) for chunk in chunks]))
            for channel in (self.topics if chunks else ())
        )

    def _stamps(self, chunk: Chunk) -> dict[int, Times]:
        """Stamps of the first and the last message of each channel that has any."""
        records = self._content(chunk)
        out: dict[int, Times] = {}
        for channel in chunk.times:
            own = [record.raw for record in records if record.channel == channel]
            kind = self.topics.get(channel, ("", ""))[1]
            stamps = [stamp_of(raw, kind, self.ros1) for raw in own[:1] + own[-1:]]
            known = [stamp for stamp in stamps if stamp is not None]
            out[channel] = np.array(known, dtype=np.int64)
        return out


def _by_channel(records: list[Record]) -> dict[int, Times]:
    """Times of reception by channel."""
    out: dict[int, list[int]] = {}
    for record in records:
        out.setdefault(record.channel, []).append(record.time_ns)
    return {channel: np.array(times, dtype=np.int64) for channel, times in out.items()}
