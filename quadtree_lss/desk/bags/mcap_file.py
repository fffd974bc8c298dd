# SPDX-License-Identifier: Apache-2.0
"""Reading mcap files in whatever state: their records from the beginning, with every check."""

from __future__ import annotations

import re
import struct

import numpy as np

from quadtree_lss.desk.bags.compression import MOST_BYTES
from quadtree_lss.desk.bags.recorded_file import INDEX, LAST_NS, ChunkedFile, Piece, Read

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, STATISTICS = 2, 3, 4, 5, 6, 7, 11
LAST_KIND, FIRST_PRIVATE = 0x0F, 0x80

_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")
_MESSAGE = struct.Struct("<HIQQ")


class McapFile(ChunkedFile):
    """An mcap file; its index and summary are used as far as they are there."""

    MAGIC = b"\x89MCAP0\r\n"
    CHUNK, MESSAGE, DECLARATIONS = CHUNK, MESSAGE, (SCHEMA, CHANNEL)
    MARK = re.compile(b"[\x05\x06]")

    def _open(self) -> None:
        self.fault = "ends before its end mark (truncated)"
        self._schemas: dict[int, str] = {}
        super()._open()

    def _piece(self, read: Read, place: int, size: int) -> Piece | None:
        head = read(place, _HEAD.size)
        if len(head) < _HEAD.size:
            return None
        kind, length = _HEAD.unpack(head)
        begin, end = place + _HEAD.size, place + _HEAD.size + length
        if kind == CHUNK:
            return self._chunk(begin, end, read(begin, _CHUNK.size + 32))
        if kind == MESSAGE:
            plausible = _MESSAGE.size <= length <= MOST_BYTES
        else:
            plausible = 0 < kind <= LAST_KIND or kind >= FIRST_PRIVATE
        return Piece(kind, {}, begin, end) if plausible and end <= size else None

    def _chunk(self, begin: int, end: int, head: bytes) -> Piece | None:
        """Every length of a chunk is told twice, so that one can be told from bytes that look
        alike."""
        try:
            _, _, size, checksum, named = _CHUNK.unpack_from(head)
            (packed,) = struct.unpack_from("<Q", head, _CHUNK.size + named)
        except struct.error:
            return None
        if begin + _CHUNK.size + named + 8 + packed != end:
            return None
        name = head[_CHUNK.size : _CHUNK.size + named].decode("ascii", "replace")
        fields = {"compression": name, "size": size, "checksum": checksum}
        return Piece(CHUNK, fields, end - packed, end)

    def _is_sure(self, piece: Piece) -> bool:
        """A message, too, if some stand outside chunks, a channel knows it, a record follows."""
        if piece.kind == CHUNK:
            return True
        alone = any(chunk.begin == chunk.place for chunk in self.chunks)
        known = alone and self._message(piece, self._read)[0] in self.topics
        return known and self._piece(self._read, piece.end, self._size) is not None

    def _message(self, piece: Piece, read: Read) -> tuple[int, int, int]:
        channel, _, time_ns, _ = _MESSAGE.unpack(read(piece.begin, _MESSAGE.size))
        return channel, min(time_ns, LAST_NS), piece.begin + _MESSAGE.size

    def _declare(self, piece: Piece, read: Read) -> None:
        content = read(piece.begin, min(piece.end - piece.begin, MOST_BYTES))
        if piece.kind == SCHEMA:
            (number,) = struct.unpack_from("<H", content)
            self._schemas[number] = _text(content, 2)
        elif piece.kind == CHANNEL:
            number, schema = struct.unpack_from("<HH", content)
            self.topics[number] = (_text(content, 4), self._schemas.get(schema, ""))
        elif piece.kind == STATISTICS:
            (size,) = struct.unpack_from("<I", content, 42)
            pairs = struct.iter_unpack("<HQ", content[46 : 46 + size])
            self.expected = sum(min(count, 2**40) for _, count in pairs)
        elif piece.kind == MESSAGE_INDEX and self.chunks:
            channel, size = struct.unpack_from("<HI", content)
            pairs = np.frombuffer(content, "<u8", size // 8, 6).reshape(-1, 2)
            entries = np.zeros(len(pairs), INDEX)
            entries["time_ns"], entries["offset"] = np.minimum(pairs, np.uint64(LAST_NS)).T
            entries["channel"] = channel
            self.chunks[-1].entries = np.concatenate([self.chunks[-1].entries, entries])
        elif piece.kind == FOOTER and piece.end == self._size - len(self.MAGIC):
            self.fault = ""


def _text(content: bytes, place: int) -> str:
    (length,) = struct.unpack_from("<I", content, place)
    end = place + 4 + length
    if end > len(content):
        raise ValueError("a text leads out of its record")
    return content[place + 4 : end].decode()
