# SPDX-License-Identifier: Apache-2.0
"""Reading ROS 1 bags (format 2.0) in whatever state: their records from the beginning."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np

from quadtree_lss.desk.bags.compression import DamagedError
from quadtree_lss.desk.bags.recorded_file import INDEX, Chunk, ChunkedFile, Record

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, BAG_HEADER, MESSAGE_INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
MOST_HEADER = 1 << 16
"""Bytes of a record's header: two names and some numbers."""
_LENGTH = struct.Struct("<I")
_BLOCK = 1 << 20

Fields = dict[str, bytes]


class Ros1File(ChunkedFile):
    """A ROS 1 bag; its index is used as far as it is there."""

    ros1 = True

    def _walk(self) -> None:
        self._packed: dict[int, tuple[str, int]] = {}
        if self._read(0, len(MAGIC)) != MAGIC:
            self.damage[0] = "no ROS 1 bag: wrong first bytes"
            return
        indexed = infos = expected = 0
        place = before = len(MAGIC)
        while place < self._size:
            found = self._record(place)
            if found is None:
                before = self._next_chunk(before)
                if before < self._size:  # otherwise the file ends here
                    self.damage.setdefault(place, "records damaged or cut out")
                place = before
                continue
            fields, begin, length = found
            kind = fields["op"][0]
            try:
                if kind == CHUNK:
                    self._packed[begin] = (fields["compression"].decode(), _number(fields["size"]))
                    self.chunks.append(Chunk(begin, length, min(length, self._size - begin)))
                elif kind == BAG_HEADER:
                    indexed = any(fields["index_pos"]) and _number(fields["chunk_count"])
                elif kind == CHUNK_INFO:
                    infos += 1
                    pairs = struct.iter_unpack("<II", self._read(begin, length))
                    expected += sum(count for _, count in pairs)
                elif kind == CONNECTION:
                    self._connect(fields, self._read(begin, length))
                elif kind == MESSAGE_INDEX and self.chunks:
                    self._add_entries(fields, self._read(begin, length))
            except (KeyError, ValueError, struct.error):
                self.damage.setdefault(place, "damaged record")
            place, before = begin + length, (begin + length if kind == CHUNK else place + 1)
        if indexed and infos == indexed:
            self.expected = expected
        else:
            self.cut = "has no usable index (truncated)"

    def _record(self, place: int) -> tuple[Fields, int, int] | None:
        """Fields, place and length of the data of a record; None if none begins here.

        The data of a chunk, which may be the last one and cut, may lead beyond the file.
        """
        start = self._read(place, _LENGTH.size)
        length = _LENGTH.unpack(start)[0] if len(start) == _LENGTH.size else 0
        if not 0 < length <= MOST_HEADER:
            return None
        head = self._read(place + _LENGTH.size, length + _LENGTH.size)
        fields = _fields(head[:length])
        if len(head) < length + _LENGTH.size or fields is None or len(fields.get("op", b"")) != 1:
            return None
        (data,) = _LENGTH.unpack_from(head, length)
        begin = place + 2 * _LENGTH.size + length
        cut = begin + data > self._size
        return None if cut and fields["op"][0] != CHUNK else (fields, begin, data)

    def _next_chunk(self, after: int) -> int:
        """Where the next chunk's record begins, else the file's end."""
        mark = bytes([len(b"op=") + 1, 0, 0, 0]) + b"op=" + bytes([CHUNK])
        while after < self._size:
            block = self._read(after, _BLOCK)
            at = block.find(mark)
            while at >= 0:
                for place in range(after + at - _LENGTH.size, max(after + at - 80, 0), -1):
                    found = self._record(place)
                    if found is not None and {"op", "compression", "size"} <= found[0].keys():
                        return place
                at = block.find(mark, at + 1)
            after += max(len(block) - len(mark), 1)
        return self._size

    def _connect(self, fields: Fields, data: bytes) -> None:
        inner = _fields(data)
        if inner is None:
            raise ValueError("a damaged connection")
        package, _, name = inner["type"].decode().partition("/")
        parts = [part for part in fields["topic"].decode().split("/") if part]
        rooted = "/" if fields["topic"][:1] == b"/" else ""
        kind = f"{package}/msg/{name.removeprefix('msg/')}"
        self.topics[_number(fields["conn"])] = (rooted + "/".join(parts), kind)

    def _add_entries(self, fields: Fields, data: bytes) -> None:
        """The index of the last chunk's messages of a connection."""
        rows = np.frombuffer(data, dtype="<u4").reshape(-1, 3).astype(np.int64)
        if len(rows) != _number(fields["count"]):
            raise ValueError("a damaged index")
        entries = np.zeros(len(rows), INDEX)
        entries["time_ns"], entries["offset"] = rows[:, 0] * 10**9 + rows[:, 1], rows[:, 2]
        entries["channel"] = _number(fields["conn"])
        self.chunks[-1].entries.append(entries)

    def _scan(self, chunk: Chunk) -> Iterator[Record]:
        compression, size = self._packed[chunk.place]
        data = self._unpack(chunk, compression, chunk.place, size)
        offset = 0
        while offset < len(data):
            place, parts = offset, []
            for _ in range(2):
                end = offset + _LENGTH.size
                length = _LENGTH.unpack_from(data, offset)[0] if end <= len(data) else len(data)
                offset = end + length
                if offset > len(data):
                    if chunk.there < chunk.length:
                        return
                    raise DamagedError("a record leads out of its chunk")
                parts.append(data[end:offset])
            fields = _fields(parts[0]) or {}
            try:
                if fields.get("op") == bytes([CONNECTION]):
                    self._connect(fields, parts[1])
                elif fields.get("op") == bytes([MESSAGE]):
                    seconds, nanoseconds = struct.unpack("<II", fields["time"])
                    time_ns = seconds * 10**9 + nanoseconds
                    yield Record(place, _number(fields["conn"]), time_ns, parts[1])
            except (KeyError, ValueError, struct.error):
                raise DamagedError("damaged record in a chunk") from None


def _number(value: bytes) -> int:
    return int.from_bytes(value[:4], "little")


def _fields(header: bytes) -> Fields | None:
    """Name and value of each field; None if the lengths do not fit."""
    fields: Fields = {}
    offset = 0
    while offset + _LENGTH.size <= len(header):
        (length,) = _LENGTH.unpack_from(header, offset)
        offset += _LENGTH.size
        name, equals, value = header[offset : offset + length].partition(b"=")
        offset += length
        if not equals or offset > len(header):
            return None
        fields[name.decode("ascii", "replace")] = value
    return fields if offset == len(header) else None
