# SPDX-License-Identifier: Apache-2.0
"""Reader of ROS 1 bags, format 2.0 (https://wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

import struct
from io import BytesIO
from typing import Any, BinaryIO

from rosbags.rosbag1.reader import Header, RecordType, normalize, read_uint32

from quadtree_lss.desk.bags.compression import DamagedError, unpack
from quadtree_lss.desk.bags.message_types import type_name
from quadtree_lss.desk.bags.recorded_file import ChunkedFile, Record

MAX_HEADER_BYTES = 1 << 16
"""Limit of a record's header, which holds two names and some numbers."""


class Ros1File(ChunkedFile):
    ros1 = True
    MAGIC = b"#ROSBAG V2.0\n"
    CHUNK, MESSAGE, MESSAGE_INDEX = RecordType.CHUNK, RecordType.MSGDATA, RecordType.IDXDATA
    NO_END = "has no usable index (truncated)"

    def _head(self, source: BinaryIO) -> tuple[int, Header, int]:
        if read_uint32(source) > MAX_HEADER_BYTES:
            raise DamagedError("no record")
        source.seek(-4, 1)
        header = Header.read(source)
        return header.get_uint8("op"), header, read_uint32(source)

    def _indexed_chunks(self) -> list[int]:
        first = next(self._records(self._file, len(self.MAGIC), self._size)).header
        positions, self.expected = [], 0
        index = first.get_uint64("index_pos") or self._size
        for record in self._records(self._file, index, self._size):
            self._parse(record)
            if record.kind == RecordType.CHUNK_INFO:
                positions.append(record.header.get_uint64("chunk_pos"))
                self.expected += sum(n for _, n in struct.iter_unpack("<II", record.content))
        if not positions or len(positions) != first.get_uint32("chunk_count"):
            raise DamagedError("no index of chunks")
        return sorted(positions)

    def _parse(self, record: Record) -> Any:
        header, content = record.header, record.content
        if record.kind == RecordType.MSGDATA:
            return header.get_time("time"), header.get_uint32("conn"), content
        if record.kind == RecordType.CHUNK:
            size = header.get_uint32("size")
            return unpack(header.get_string("compression"), content, size), size
        if record.kind == RecordType.IDXDATA:
            channel, rows = header.get_uint32("conn"), struct.iter_unpack("<III", content)
            return [(offset, channel, sec * 10**9 + nanosec) for sec, nanosec, offset in rows]
        if record.kind == RecordType.CONNECTION:
            described = Header.read(BytesIO(struct.pack("<I", len(content)) + content))
            kind = type_name(described.get_string("type"))
            topic = normalize(header.get_string("topic"))
            self.topics[header.get_uint32("conn")] = (topic, kind)
        return None
