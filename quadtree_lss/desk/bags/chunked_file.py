# SPDX-License-Identifier: Apache-2.0
"""Files of records, some of which are chunks of messages: mcap (https://mcap.dev/spec) and ROS 1
bags, format 2.0 (https://wiki.ros.org/Bags/Format/2.0)."""

from __future__ import annotations

import struct
import zlib
from abc import abstractmethod
from collections.abc import Iterable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from rosbags.rosbag1.reader import Header, RecordType, normalize, read_uint32

from quadtree_lss.desk.bags.compression import MAX_BYTES, DamagedError, unpack
from quadtree_lss.desk.bags.message_types import type_name
from quadtree_lss.desk.bags.recorded_file import DAMAGE, LAST_NS, RecordedFile, Row

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(2, 9)
STATISTICS = 11
DECODED = ("cdr", "ros1", "")
"""Message encodings that are decoded."""
END_BYTES = 37
"""Size of the footer and the magic bytes after it."""
MAX_HEADER_BYTES = 1 << 16
"""Limit of a record's header, which holds two names and some numbers."""


class Record(NamedTuple):
    """A record of a file or chunk: kind, header, position, content."""

    kind: int
    header: Any
    position: int
    content: bytes


class ChunkedFile(RecordedFile):
    """A file of records, some of which are chunks of messages: mcap and ROS 1 bags."""

    MAGIC: bytes
    CHUNK: int
    MESSAGE: int
    MESSAGE_INDEX: int
    END = -1  # kind of the record that ends a complete file
    NO_END: str  # fault of a file that is read without its index and lacks that record

    @abstractmethod
    def _head(self, source: BinaryIO) -> tuple[int, Any, int]:
        """Read the start of a record: kind, header, length of the content."""

    @abstractmethod
    def _indexed_chunks(self) -> list[int]:
        """Return the positions of the chunks from the file's index. Raises one of `DAMAGE`."""

    @abstractmethod
    def _parse(self, record: Record) -> Any:
        """Parse a record. Return time of reception, channel and bytes of a message; offset, channel
        and time of each message in a `MESSAGE_INDEX`; decompressed content and declared size of a
        chunk; None for others, such as topics, which are stored."""

    def _rows(self) -> Iterable[Row]:
        if self._file.read(len(self.MAGIC)) != self.MAGIC:
            self.fault = f"wrong first bytes of a {self.path.suffix} file"
            return []
        try:
            positions = self._indexed_chunks()
        except DAMAGE:
            positions = self._scan_chunks()
        rows: list[Row] = []
        for position in positions:
            listed = self._indexed_rows(position)
            known = listed and {row[1] for row in listed} <= self.topics.keys()
            rows += listed if known else [row for row, _ in self._messages(position)]
        return rows

    def _indexed_rows(self, position: int) -> list[Row]:
        """Return the rows in the index after a chunk; empty if it is damaged."""
        entries: list[tuple[int, int, int]] = []
        try:
            for record in self._records(self._file, position, self._size, skip=self.CHUNK):
                if record.kind == self.MESSAGE_INDEX:
                    entries += self._parse(record)
                elif record.position != position:
                    break
        except DAMAGE:
            return []
        return [
            (min(t, LAST_NS), channel, position, offset) for offset, channel, t in sorted(entries)
        ]

    def _records(
        self, source: BinaryIO, position: int, end: int, skip: int = -1
    ) -> Iterator[Record]:
        """Yield records from a position on, those of kind ``skip`` without content; a chunk may be
        truncated. Raises one of `DAMAGE`."""
        while position < end:
            source.seek(position)
            kind, header, length = self._head(source)
            after = source.tell() + length
            if after <= end or kind == self.CHUNK:
                size = 0 if kind == skip else min(length, MAX_BYTES)
                yield Record(kind, header, position, source.read(size))
            position = after
        if position > end:
            raise DamagedError("a record is truncated")

    def _scan_chunks(self) -> list[int]:
        """Find the positions of chunks, and of messages outside chunks, up to the first damage."""
        self.fault, self.expected = self.NO_END, None
        positions: list[int] = []
        try:
            begin = len(self.MAGIC)
            for record in self._records(self._file, begin, self._size, skip=self.CHUNK):
                if record.kind in (self.CHUNK, self.MESSAGE):
                    positions.append(record.position)
                elif record.kind == self.END:
                    self.fault = ""
                    break
                else:
                    self._parse(record)
        except DAMAGE:
            self.fault = f"damaged or truncated after byte {max(positions, default=0)}"
        return positions

    def _load(self, position: int) -> Iterator[tuple[Row, bytes]]:
        chunk = next(self._records(self._file, position, self._size), None)
        if chunk is None or chunk.kind not in (self.CHUNK, self.MESSAGE):
            raise DamagedError("no chunk")
        records, data, size = iter([chunk]), b"", 0
        if chunk.kind == self.CHUNK:
            data, size = self._parse(chunk)
            records = self._records(BytesIO(data), 0, len(data))
        for record in records:
            parsed = self._parse(record)
            if record.kind == self.MESSAGE:
                yield (min(parsed[0], LAST_NS), parsed[1], position, record.position), parsed[2]
        if len(data) != size:
            raise DamagedError(f"chunk of {len(data)} bytes instead of {size}")


class McapFile(ChunkedFile):
    MAGIC = b"\x89MCAP0\r\n"
    CHUNK, MESSAGE, MESSAGE_INDEX, END = CHUNK, MESSAGE, MESSAGE_INDEX, FOOTER
    NO_END = "ends before its end mark (truncated)"

    def __init__(self, path: Path) -> None:
        self._schemas: dict[int, str] = {}
        super().__init__(path)

    def _head(self, source: BinaryIO) -> tuple[int, None, int]:
        kind, length = struct.unpack("<BQ", source.read(9))
        if not kind:
            raise DamagedError("no record")
        return kind, None, length

    def _indexed_chunks(self) -> list[int]:
        self._file.seek(self._size - END_BYTES)
        kind, _, summary, _, _, magic = struct.unpack("<BQQQI8s", self._file.read(END_BYTES))
        if kind != FOOTER or not summary or magic != self.MAGIC:
            raise DamagedError("no summary")
        positions = []
        for record in self._records(self._file, summary, self._size - END_BYTES):
            self._parse(record)
            if record.kind == CHUNK_INDEX:
                positions.append(struct.unpack_from("<Q", record.content, 16)[0])
        if not positions:
            raise DamagedError("no index of chunks")
        return sorted(positions)

    def _parse(self, record: Record) -> Any:
        content = record.content
        if record.kind == MESSAGE:
            channel, _, time_ns, _ = struct.unpack_from("<HIQQ", content)
            return time_ns, channel, content[22:]
        if record.kind == CHUNK:
            size, checksum = struct.unpack_from("<QI", content, 16)
            compression = _text(content, 28)
            data = unpack(compression, content[40 + len(compression) :], size)
            if checksum and len(data) == size and zlib.crc32(data) != checksum:
                raise DamagedError("wrong checksum of a chunk")
            return data, size
        if record.kind == MESSAGE_INDEX:
            channel, size = struct.unpack_from("<HI", content)
            pairs = struct.iter_unpack("<QQ", content[6 : 6 + size])
            return [(offset, channel, time_ns) for time_ns, offset in pairs]
        if record.kind == SCHEMA:
            self._schemas[struct.unpack_from("<H", content)[0]] = _text(content, 2)
        elif record.kind == CHANNEL:
            number, schema = struct.unpack_from("<HH", content)
            topic = _text(content, 4)
            encoding = _text(content, 8 + len(topic.encode()))
            self.ros1 = encoding == "ros1"
            kind = type_name(self._schemas.get(schema, "")) or "unknown type"
            self.topics[number] = (topic, kind if encoding in DECODED else f"{kind} as {encoding}")
        elif record.kind == STATISTICS:
            self.expected = struct.unpack_from("<Q", content)[0]
        return None


def _text(content: bytes, position: int) -> str:
    (length,) = struct.unpack_from("<I", content, position)
    text: bytes = struct.unpack_from(f"{length}s", content, position + 4)[0]
    return text.decode()


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
