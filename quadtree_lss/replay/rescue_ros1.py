# SPDX-License-Identifier: Apache-2.0
"""What can still be read of a damaged or unfinished ROS 1 bag: its records from the beginning."""

from __future__ import annotations

import bz2
import struct
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]

from quadtree_lss.replay.rescue import Extent, RawMessage, count_messages

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, CHUNK, CONNECTION = 2, 5, 7
MAX_HEADER = 1 << 20
_LENGTH = struct.Struct("<I")


class RescuedRos1:
    """A ROS 1 bag (format 2.0) read without its index."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.losses: list[str] = []
        self._topics: dict[int, str] = {}
        self._types: dict[str, str] = {}

    def extent(self) -> Extent:
        """Topics, numbers of messages and times, by reading the whole file once."""
        counted = count_messages(self.messages())
        return Extent(dict(self._types), *counted)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages in the order of their chunks, by time within each; None for all topics."""
        self.losses = ["the ROS 1 bag has no usable index"]
        with open(self.path, "rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                self.losses = [f"{self.path.name}: no ROS 1 bag"]
                return
            try:
                for header, data in _file_records(file):
                    if header.get("op") != bytes([CHUNK]):
                        continue
                    yield from self._chunk(header, data, topics)
            except (EOFError, ValueError) as error:
                self.losses.append(f"{self.path.name}: {error}")

    def _chunk(
        self, header: dict[str, bytes], data: bytes, topics: Collection[str] | None
    ) -> Iterator[RawMessage]:
        found: list[RawMessage] = []
        try:
            for inner, content in _records(_uncompressed(header, data)):
                kind = inner.get("op", b"")
                if kind == bytes([CONNECTION]):
                    self._connect(inner, content)
                elif kind == bytes([MESSAGE]):
                    topic = self._topics.get(int.from_bytes(inner["conn"], "little"), "")
                    if topic and (topics is None or topic in topics):
                        seconds, nanoseconds = struct.unpack("<II", inner["time"])
                        received = seconds * 1_000_000_000 + nanoseconds
                        found.append(RawMessage(topic, received, content))
        except (EOFError, OSError, RuntimeError, ValueError, KeyError, struct.error) as error:
            self.losses.append(f"{self.path.name}: damaged chunk: {error}")
        yield from sorted(found, key=lambda message: message.received_ns)

    def _connect(self, header: dict[str, bytes], data: bytes) -> None:
        topic = header["topic"].decode()
        package, _, name = _fields(data)["type"].decode().partition("/")
        self._topics[int.from_bytes(header["conn"], "little")] = topic
        self._types[topic] = f"{package}/msg/{name}"


def _file_records(file: BinaryIO) -> Iterator[tuple[dict[str, bytes], bytes]]:
    """Records of the file; what there is of a cut last one, then EOFError."""
    while start := file.read(_LENGTH.size):
        length = _LENGTH.unpack(start)[0] if len(start) == _LENGTH.size else MAX_HEADER + 1
        if length > MAX_HEADER:
            msg = "a record header is damaged"
            raise ValueError(msg)
        header = file.read(length)
        size = file.read(_LENGTH.size)
        if len(size) < _LENGTH.size:
            msg = "ends within a record (truncated)"
            raise EOFError(msg)
        (expected,) = _LENGTH.unpack(size)
        data = file.read(expected)
        yield _fields(header), data
        if len(data) < expected:
            msg = "ends within a record (truncated)"
            raise EOFError(msg)


def _records(data: bytes) -> Iterator[tuple[dict[str, bytes], bytes]]:
    """Whole records of a chunk; EOFError at one that is cut."""
    offset = 0
    while offset < len(data):
        parts = []
        for _ in range(2):
            end = offset + _LENGTH.size
            (length,) = _LENGTH.unpack_from(data, offset) if end <= len(data) else (len(data),)
            offset = end + length
            if offset > len(data):
                msg = "a record is cut short"
                raise EOFError(msg)
            parts.append(data[end:offset])
        yield _fields(parts[0]), parts[1]


def _fields(header: bytes) -> dict[str, bytes]:
    fields: dict[str, bytes] = {}
    offset = 0
    while offset + _LENGTH.size <= len(header):
        (length,) = _LENGTH.unpack_from(header, offset)
        offset += _LENGTH.size
        name, _, value = header[offset : offset + length].partition(b"=")
        fields[name.decode("ascii", "replace")] = value
        offset += length
    return fields


def _uncompressed(header: dict[str, bytes], data: bytes) -> bytes:
    """Records of a chunk, or their beginning if it is cut."""
    compression = header.get("compression", b"none")
    if compression == b"none":
        return data
    if compression == b"bz2":
        return bz2.BZ2Decompressor().decompress(data)
    if compression == b"lz4":
        records: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data)
        return records
    msg = f"unknown compression {compression!r}"
    raise ValueError(msg)
