# SPDX-License-Identifier: Apache-2.0
"""A file of recorded messages in whatever state: an index of them, their order, what was lost.

Whole files are indexed by what they say of themselves; of a damaged one each chunk is opened for
that. A damaged chunk costs no more than itself.
"""

from __future__ import annotations

import re
import struct
import zlib
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
_BLOCK = 1 << 20

Read = Callable[[int, int], bytes]
"""Bytes of a file or of a chunk, from a place on, so many if they are there."""


class RawMessage(NamedTuple):
    """A message as recorded: topic, time of reception, serialised bytes."""

    topic: str
    received_ns: int
    raw: bytes


class RecordedFile(ABC):
    """A file of messages: topic and type by number of the channel; (M,) `INDEX` of the messages in
    the order of the file, and the ``order`` in which they are read; ``counts`` by topic; ``notes``
    to know, a line each.

    What was lost: the ``fault`` of the file as a whole and the ``disorder`` of its chunks, or
    empty; what is wrong (``damage``) and how many messages are ``lost``, by the byte or row; how
    many are ``expected`` by what the file's end says, None if that cannot be read.
    """

    ros1 = False
    unit = "byte"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics: dict[int, tuple[str, str]] = {}
        self.index = np.zeros(0, INDEX)
        self.notes: list[str] = []
        self.fault = self.disorder = ""
        self.damage: dict[int, str] = {}
        self.lost: dict[int, int] = {}
        self.expected: int | None = None
        self._size = path.stat().st_size
        self._file = path.open("rb")
        self._open()
        times = self.index["time_ns"]
        self.impossible_times = mend_times(times)
        self.start_ns = int(times.min(initial=LAST_NS))
        self.end_ns = int(times.max(initial=0))
        self.counts = Counter(self.topics[c][0] for c in self.index["channel"].tolist())
        self.order = self._order()

    @abstractmethod
    def _open(self) -> None:
        """Finds topics and messages; the file stays open."""

    @abstractmethod
    def _contents(self, places: NDArray[np.intp]) -> Iterator[tuple[int, bytes]]:
        """Place in the index and serialised bytes of those messages that can be read."""

    def close(self) -> None:
        """Ends reading."""
        self._file.close()

    @property
    def losses(self) -> list[str]:
        """One line if something could not be read, up to now."""
        faults = [f"{why} at {self.unit} {place}" for place, why in sorted(self.damage.items())]
        if len(faults) > 1:
            faults = [f"{len(faults)} places damaged, the first: {faults[0]}"]
        if self.impossible_times:
            faults.append(f"{self.impossible_times} impossible times of reception, mended")
        parts = [part for part in (self.fault, *faults, self.disorder) if part]
        lost = sum(self.lost.values())
        if self.expected is not None:
            lost += max(self.expected - len(self.index), 0)
        if lost or self.damage or self.fault:
            unknown = f"at least {lost} messages lost: " if lost else ""
            unknown += "how many there were is not known"
            known = f"{lost} of {self.expected} messages lost"
            parts.append(unknown if self.expected is None else known)
        return [f"{self.path.name}: {', '.join(parts)}"] if parts else []

    def messages(
        self, topics: Collection[str], start_ns: int, stop_ns: int
    ) -> Iterator[RawMessage]:
        """Messages with start_ns <= time of reception < stop_ns, in the order of their times or,
        if a clock stepped back, in that of the file."""
        wanted = [channel for channel, (name, _) in self.topics.items() if name in topics]
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
            _, first = np.unique(self.index["chunk"], return_index=True)
            if (np.diff(np.minimum.reduceat(self.index["time_ns"], first)) < 0).any():
                self.disorder = "chunks out of order, put in that of their times"
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


class Piece(NamedTuple):
    """A record of a file or a chunk: its kind, what its head says, and where in the file or chunk
    its content begins and it ends."""

    kind: int
    fields: dict[str, Any]
    begin: int
    end: int


class Message(NamedTuple):
    """Of a chunk: number of its channel, time of reception, serialised bytes."""

    channel: int
    time_ns: int
    raw: bytes


@dataclass
class Chunk:
    """Messages packed together: ``place`` of their record in the file, where they ``begin`` and
    ``end``, their compression, size unpacked and checksum or 0; ``entries`` are their `INDEX`, at
    first as far as the file tells. A message outside chunks is one that begins at its place."""

    place: int
    begin: int
    end: int
    compression: str
    size: int
    checksum: int = 0
    entries: NDArray[Any] = field(default_factory=lambda: np.zeros(0, INDEX))


class ChunkedFile(RecordedFile):
    """A file of chunks, such as mcap and ROS 1 bags: a chain of records. Where it breaks, it is
    taken up again at the next chunk that can be told."""

    MAGIC: bytes
    CHUNK: int
    MESSAGE: int
    DECLARATIONS: tuple[int, ...]
    """Kinds of records of a chunk that tell of channels."""
    MARK: re.Pattern[bytes]
    """What the record of a chunk holds, in its first bytes (of a number in ``BEFORE``)."""
    BEFORE = range(1)

    @abstractmethod
    def _piece(self, read: Read, place: int, size: int) -> Piece | None:
        """The record that begins at a place; None if none does. Only a chunk, which may be the
        last and cut, may lead beyond the ``size`` of what is read."""

    @abstractmethod
    def _declare(self, piece: Piece, read: Read) -> None:
        """Notes what a record that is neither chunk nor message tells: a channel, the index of the
        last chunk, what is expected; that the file is whole. Raises ValueError, KeyError or
        struct.error: it is damaged."""

    @abstractmethod
    def _message(self, piece: Piece, read: Read) -> tuple[int, int, int]:
        """Channel and time of a message, and where its serialised bytes begin."""

    def _is_sure(self, piece: Piece) -> bool:
        """Whether what was found in the middle of damaged bytes is a record."""
        return piece.kind == self.CHUNK

    def _open(self) -> None:
        self.chunks: list[Chunk] = []
        self._walk()
        # What a damaged file says of itself may be damaged too.
        sound = not self.damage and not self.fault
        for number, chunk in enumerate(self.chunks):
            told = chunk.entries[np.argsort(chunk.entries["offset"], kind="stable")]
            if not (sound and len(told) and set(told["channel"].tolist()) <= self.topics.keys()):
                messages = self._messages(chunk).items()
                found = [(m.time_ns, place, m.channel, number) for place, m in messages]
                if self.expected is None:  # otherwise what is missing counts already
                    self.lost[chunk.place] = max(len(told) - len(found), 0)
                told = np.array(found, INDEX)
            told["chunk"] = number
            chunk.entries = told[np.isin(told["channel"], list(self.topics))]
        self.index = np.concatenate([self.index, *(chunk.entries for chunk in self.chunks)])

    def _read(self, place: int, length: int) -> bytes:
        self._file.seek(place)
        return self._file.read(length)

    def _walk(self) -> None:
        """Finds chunks, channels and what is expected, without opening a chunk."""
        place = after = len(self.MAGIC)
        if self._read(0, place) != self.MAGIC:
            self.fault = f"wrong first bytes of a {self.path.suffix} file"
            return
        while place < self._size:
            piece = self._piece(self._read, place, self._size)
            if piece is None:
                after = self._next(after)
                if after < self._size:  # otherwise the file ends here
                    self.damage.setdefault(place, "records damaged or cut out")
                place = after
                continue
            if piece.kind == self.CHUNK:
                self.chunks.append(Chunk(place, piece.begin, piece.end, **piece.fields))
            elif piece.kind == self.MESSAGE:
                self.chunks.append(Chunk(place, place, piece.end, "", piece.end - place))
            else:
                try:
                    self._declare(piece, self._read)
                except (KeyError, ValueError, struct.error):
                    self.damage.setdefault(place, "damaged record")
            # A chunk's length is sure; what leads out of another record may be damaged itself.
            after = piece.end if piece.kind == self.CHUNK else place + 1
            place = piece.end

    def _next(self, after: int) -> int:
        """Where the next record begins that is sure, else the file's end."""
        while after < self._size:
            block = self._read(after, _BLOCK)
            for found in self.MARK.finditer(block):
                for before in self.BEFORE:
                    place = max(after + found.start() - before, 0)
                    piece = self._piece(self._read, place, self._size)
                    if piece is not None and self._is_sure(piece):
                        return place
            after += max(len(block) - 16, 1)  # so that no mark is cut
        return self._size

    def _content(self, chunk: Chunk) -> bytes:
        """Unpacked; of a cut chunk what is there. Raises `DamagedError`: not what it says."""
        length, cut = chunk.end - chunk.begin, chunk.end > self._size
        if length > MOST_BYTES:
            raise DamagedError(f"chunk of {length} bytes, {MOST_BYTES} is the most,")
        data = unpack(chunk.compression, self._read(chunk.begin, length), chunk.size)
        if not cut and len(data) != chunk.size:
            raise DamagedError(f"chunk of {len(data)} bytes instead of {chunk.size}")
        if not cut and chunk.checksum and zlib.crc32(data) != chunk.checksum:
            raise DamagedError("wrong checksum of a chunk")
        return data

    def _messages(self, chunk: Chunk) -> dict[int, Message]:
        """Messages of a chunk by their place in it, up to the first record that is damaged, which
        is noted, as are the channels that it declares."""
        found: dict[int, Message] = {}
        try:
            data, place = self._content(chunk), 0

            def read(begin: int, length: int) -> bytes:
                return data[begin : begin + length]

            while place < len(data):
                piece = self._piece(read, place, len(data))
                if piece is None or piece.end > len(data):
                    if chunk.end > self._size:
                        break
                    raise DamagedError("a record leads out of its chunk")
                if piece.kind == self.MESSAGE:
                    channel, time_ns, begin = self._message(piece, read)
                    found[place] = Message(channel, time_ns, data[begin : piece.end])
                elif piece.kind in self.DECLARATIONS:
                    self._declare(piece, read)
                place = piece.end
        except DamagedError as error:
            self.damage.setdefault(chunk.place, str(error))
        except (KeyError, ValueError, struct.error):
            self.damage.setdefault(chunk.place, "damaged record in a chunk")
        return found

    def _checked(self, chunk: Chunk) -> dict[int, Message]:
        """Messages of a chunk; those of its index that are not there are lost."""
        found = self._messages(chunk)
        told = zip(chunk.entries["offset"].tolist(), chunk.entries["channel"].tolist(), strict=True)
        lost = sum(at not in found or found[at].channel != channel for at, channel in told)
        if lost:
            self.lost[chunk.place] = lost
            self.damage.setdefault(chunk.place, "messages missing in a chunk")
        return found

    def _contents(self, places: NDArray[np.intp]) -> Iterator[tuple[int, bytes]]:
        left = Counter(self.index["chunk"][places].tolist())
        held: dict[int, dict[int, Message]] = {}
        for place in map(int, places):
            entry = self.index[place]
            number, offset, channel = int(entry["chunk"]), int(entry["offset"]), entry["channel"]
            if number not in held:
                held[number] = self._checked(self.chunks[number])
            record = held[number].get(offset)
            left[number] -= 1
            if not left[number]:
                del held[number]
            if record is not None and record.channel == channel:
                yield place, record.raw


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


def stamp_of(raw: bytes, ros1: bool) -> int:
    """Stamp of a serialised message that begins with its header, ns; -1 if it is cut short."""
    try:
        raw = plain_message(raw)
        big = not ros1 and raw[1] == 0
        seconds, nanoseconds = struct.unpack_from(">II" if big else "<II", raw, 4)
    except (DamagedError, struct.error, IndexError):
        return -1
    return int(seconds) * 10**9 + int(nanoseconds)
