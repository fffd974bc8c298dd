# SPDX-License-Identifier: Apache-2.0
"""Reading mcap files in whatever state: their records from the beginning, with every check.

Where the chain of records breaks, it is taken up again at the next chunk (or, in a file without
chunks, the next message) that can be told by its lengths.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterator

import numpy as np

from quadtree_lss.desk.bags.compression import MOST_BYTES, DamagedError
from quadtree_lss.desk.bags.recorded_file import INDEX, Chunk, ChunkedFile, Record, as_times

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, STATISTICS = 2, 3, 4, 5, 6, 7, 11
LAST_KIND, FIRST_PRIVATE = 0x0F, 0x80

_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_MESSAGE = struct.Struct("<HIQQ")
_CANDIDATE = re.compile(b"[\x05\x06]")
_BLOCK = 1 << 20


class McapFile(ChunkedFile):
    """An mcap file; its index and summary are used as far as they are there."""

    def _walk(self) -> None:
        self._schemas: dict[int, str] = {}
        self._alone: set[int] = set()  # messages outside chunks
        if self._read(0, len(MAGIC)) != MAGIC:
            self.damage[0] = "no mcap file: wrong first bytes"
            return
        place = before = len(MAGIC)
        while place < self._size:
            kind, length = self._head(place)
            if kind == FOOTER and length == 20 and place == self._size - 37:
                return
            if not self._plausible(place):
                before = self._next_chunk(before)
                if before < self._size:  # otherwise the file ends here
                    self.damage.setdefault(place, "records damaged or cut out")
                place = before
                continue
            begin, end = place + _HEAD.size, place + _HEAD.size + length
            if kind == CHUNK:
                self.chunks.append(Chunk(begin, length, min(length, self._size - begin)))
            elif kind == MESSAGE:
                self._alone.add(place)
                self.chunks.append(Chunk(place, end - place, min(end, self._size) - place))
            else:
                try:
                    self._declare(kind, self._read(begin, min(length, MOST_BYTES)))
                except (struct.error, UnicodeDecodeError, ValueError):
                    self.damage.setdefault(place, "damaged record")
            # A chunk's length is sure; what leads out of another record may be damaged itself.
            before, place = (end if kind == CHUNK else place + 1), end
        self.cut = "ends before its end mark (truncated)"

    def _head(self, place: int) -> tuple[int, int]:
        head = self._read(place, _HEAD.size)
        return _HEAD.unpack(head) if len(head) == _HEAD.size else (0, 0)

    def _plausible(self, place: int) -> bool:
        """Whether a record may begin here; a last one may be cut."""
        kind, length = self._head(place)
        begin = place + _HEAD.size
        if kind == CHUNK:
            return self._records_of(begin, length) is not None
        if kind == MESSAGE:
            return _MESSAGE.size <= length <= MOST_BYTES
        return (0 < kind <= LAST_KIND or kind >= FIRST_PRIVATE) and begin + length <= self._size

    def _records_of(self, begin: int, length: int) -> tuple[str, int, int, int] | None:
        """Compression, size unpacked, checksum and place of a chunk's records; None if it is none.

        Every length of a chunk is told twice, so that one can be told from bytes that look alike.
        """
        head = self._read(begin, _CHUNK.size + 32)
        if len(head) < _CHUNK.size + 8:
            return None
        _, _, size, checksum, named = _CHUNK.unpack_from(head)
        if named > 16 or len(head) < _CHUNK.size + named + 8:
            return None
        (packed,) = struct.unpack_from("<Q", head, _CHUNK.size + named)
        begins = _CHUNK.size + named + 8
        if begins + packed != length:
            return None
        name = head[_CHUNK.size : begins - 8].decode("ascii", "replace")
        return name, size, checksum, begin + begins

    def _next_chunk(self, after: int) -> int:
        """Where the next chunk begins, or the next message outside chunks; else the file's end."""
        while after < self._size:
            block = self._read(after, _BLOCK)
            for found in _CANDIDATE.finditer(block):
                place = after + found.start()
                if block[found.start()] == CHUNK:
                    if self._plausible(place):
                        return place
                elif self._alone and self._is_message(place):
                    return place
            after += _BLOCK
        return self._size

    def _is_message(self, place: int) -> bool:
        """Whether a message begins here: of a known channel, and followed by a record."""
        _, length = self._head(place)
        if not self._plausible(place):
            return False
        (channel,) = struct.unpack("<H", self._read(place + _HEAD.size, 2))
        return channel in self.topics and self._plausible(place + _HEAD.size + length)

    def _declare(self, kind: int, content: bytes) -> None:
        """A schema, a channel, the index of the last chunk, or the numbers at the file's end."""
        if kind == SCHEMA:
            (number,) = struct.unpack_from("<H", content)
            self._schemas[number] = _text(content, 2)
        elif kind == CHANNEL:
            number, schema = struct.unpack_from("<HH", content)
            self.topics[number] = (_text(content, 4), self._schemas.get(schema, ""))
        elif kind == STATISTICS:
            (size,) = struct.unpack_from("<I", content, 42)
            pairs = struct.iter_unpack("<HQ", content[46 : 46 + size])
            self.expected = sum(min(count, 2**40) for _, count in pairs)
        elif kind == MESSAGE_INDEX and self.chunks and self.chunks[-1].place not in self._alone:
            channel, size = struct.unpack_from("<HI", content)
            pairs = np.frombuffer(content, "<u8", size // 8, 6).reshape(-1, 2)
            entries = np.zeros(len(pairs), INDEX)
            entries["time_ns"], entries["offset"] = as_times(pairs[:, 0]), as_times(pairs[:, 1])
            entries["channel"] = channel
            self.chunks[-1].entries.append(entries)

    def _scan(self, chunk: Chunk) -> Iterator[Record]:
        if chunk.place in self._alone:
            records = self._read(chunk.place, chunk.there)
        else:
            records = self._unpacked(chunk)
        offset = 0
        while offset + _HEAD.size <= len(records):
            kind, length = _HEAD.unpack_from(records, offset)
            begin, end = offset + _HEAD.size, offset + _HEAD.size + length
            if end > len(records):
                break
            if kind in (SCHEMA, CHANNEL):
                try:
                    self._declare(kind, records[begin:end])
                except (struct.error, ValueError) as error:
                    raise DamagedError("damaged record in a chunk") from error
            elif kind == MESSAGE and length >= _MESSAGE.size:
                channel, _, time_ns, _ = _MESSAGE.unpack_from(records, begin)
                time_ns = min(time_ns, 2**63 - 1)
                yield Record(offset, channel, time_ns, records[begin + _MESSAGE.size : end])
            offset = end
        if offset != len(records) and chunk.there == chunk.length:
            raise DamagedError("a record leads out of its chunk")

    def _unpacked(self, chunk: Chunk) -> bytes:
        found = self._records_of(chunk.place, chunk.length)
        if found is None:
            raise DamagedError("damaged chunk")
        compression, size, checksum, begin = found
        records = self._unpack(chunk, compression, begin, size)
        if chunk.there == chunk.length and checksum and zlib.crc32(records) != checksum:
            raise DamagedError("wrong checksum of a chunk")
        return records


def _text(content: bytes, place: int) -> str:
    (length,) = struct.unpack_from("<I", content, place)
    end = place + 4 + length
    if end > len(content):
        raise ValueError("a text leads out of its record")
    return content[place + 4 : end].decode()
