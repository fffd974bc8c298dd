# SPDX-License-Identifier: Apache-2.0
"""Reader of mcap files (https://mcap.dev/spec)."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any, BinaryIO

from quadtree_lss.desk.bags.compression import DamagedError, unpack
from quadtree_lss.desk.bags.message_types import type_name
from quadtree_lss.desk.bags.recorded_file import ChunkedFile, Record

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(2, 9)
STATISTICS = 11
DECODED = ("cdr", "ros1", "")
"""Message encodings that are decoded."""
END_BYTES = 37
"""Size of the footer and the magic bytes after it."""


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
