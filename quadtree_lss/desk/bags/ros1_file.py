# SPDX-License-Identifier: Apache-2.0
"""Reading ROS 1 bags (format 2.0) in whatever state: their records from the beginning."""

from __future__ import annotations

import re
import struct

import numpy as np

from quadtree_lss.desk.bags.recorded_file import INDEX, ChunkedFile, Piece, Read

MESSAGE, BAG_HEADER, MESSAGE_INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
MOST_HEADER = 1 << 16
"""Bytes of a record's header: two names and some numbers."""
NO_INDEX = "has no usable index (truncated)"
_PAIR = struct.Struct("<II")


class Ros1File(ChunkedFile):
    """A ROS 1 bag; its index is used as far as it is there."""

    ros1 = True
    MAGIC = b"#ROSBAG V2.0\n"
    CHUNK, MESSAGE, DECLARATIONS = CHUNK, MESSAGE, (CONNECTION,)
    MARK = re.compile(b"\x04\0\0\0op=\x05")
    BEFORE = range(4, 80)

    _chunks = _infos = _told = 0
    """Chunks that the file's first record tells of; those listed at its end, their messages."""

    def _open(self) -> None:
        self.fault = NO_INDEX
        super()._open()

    def _piece(self, read: Read, place: int, size: int) -> Piece | None:
        length = _number(read(place, 4))
        if not 0 < length <= MOST_HEADER:
            return None
        head = read(place + 4, length + 4)
        fields = _fields(head[:length])
        if len(head) < length + 4 or fields is None or len(fields.get("op", b"")) != 1:
            return None
        begin = place + length + 8
        piece = Piece(fields["op"][0], fields, begin, begin + _number(head[length:]))
        if piece.kind != CHUNK:
            return piece if piece.end <= size else None
        if not {"compression", "size"} <= fields.keys():
            return None
        name = fields["compression"].decode("ascii", "replace")
        return piece._replace(fields={"compression": name, "size": _number(fields["size"])})

    def _message(self, piece: Piece, read: Read) -> tuple[int, int, int]:
        seconds, nanoseconds = _PAIR.unpack(piece.fields["time"])
        return _number(piece.fields["conn"]), seconds * 10**9 + nanoseconds, piece.begin

    def _declare(self, piece: Piece, read: Read) -> None:
        fields, content = piece.fields, read(piece.begin, piece.end - piece.begin)
        if piece.kind == BAG_HEADER:
            self._chunks = _number(fields["chunk_count"]) if any(fields["index_pos"]) else 0
        elif piece.kind == CHUNK_INFO:
            self._infos += 1
            self._told += sum(count for _, count in _PAIR.iter_unpack(content))
            whole = self._infos == self._chunks
            self.fault, self.expected = ("", self._told) if whole else (NO_INDEX, None)
        elif piece.kind == CONNECTION:
            package, _, name = (_fields(content) or {})["type"].decode().partition("/")
            topic = re.sub("/+", "/", fields["topic"].decode()).rstrip("/")
            kind = f"{package}/msg/{name.removeprefix('msg/')}"
            self.topics[_number(fields["conn"])] = (topic, kind)
        elif piece.kind == MESSAGE_INDEX and self.chunks:
            rows = np.frombuffer(content, "<u4").reshape(-1, 3).astype(np.int64)
            if len(rows) != _number(fields["count"]):
                raise ValueError("a damaged index")
            entries = np.zeros(len(rows), INDEX)
            entries["time_ns"], entries["offset"] = rows[:, 0] * 10**9 + rows[:, 1], rows[:, 2]
            entries["channel"] = _number(fields["conn"])
            self.chunks[-1].entries = np.concatenate([self.chunks[-1].entries, entries])


def _number(value: bytes) -> int:
    return int.from_bytes(value[:4], "little")


def _fields(header: bytes) -> dict[str, bytes] | None:
    """Name and value of each field; None if the lengths do not fit."""
    fields: dict[str, bytes] = {}
    offset = 0
    while offset + 4 <= len(header):
        end = offset + 4 + _number(header[offset : offset + 4])
        name, equals, value = header[offset + 4 : end].partition(b"=")
        if not equals or end > len(header):
            return None
        fields[name.decode("ascii", "replace")] = value
        offset = end
    return fields if offset == len(header) else None
