# SPDX-License-Identifier: Apache-2.0
"""What can still be read of a damaged mcap file.

It is walked record by record from its beginning, since the index at its end may be missing; a
damaged or cut chunk costs no more than itself. ``losses`` lists what was lost.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Collection, Iterable, Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Schema

MCAP_MAGIC = b"\x89MCAP0\r\n"
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQI")
_MESSAGE = struct.Struct("<HIQQ")
_DAMAGE = (struct.error, zlib.error, zstandard.ZstdError, RuntimeError, ValueError, EOFError)


class RawMessage(NamedTuple):
    """A message as recorded: topic, time of reception, serialised bytes."""

    topic: str
    received_ns: int
    raw: bytes


class Extent(NamedTuple):
    """What a first pass over a file finds."""

    types: dict[str, str]
    counts: dict[str, int]
    start_ns: int
    end_ns: int


def count_messages(messages: Iterable[RawMessage]) -> tuple[dict[str, int], int, int]:
    """Messages by topic, first and last time of reception."""
    counts: dict[str, int] = {}
    start, end = 2**63 - 1, 0
    for message in messages:
        counts[message.topic] = counts.get(message.topic, 0) + 1
        start, end = min(start, message.received_ns), max(end, message.received_ns)
    return counts, start, end


class RescuedMcap:
    """An mcap file read without its index; use `messages` alone or after `extent`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.losses: list[str] = []
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}

    def extent(self) -> Extent:
        """Topics, numbers of messages and times, by reading the whole file once."""
        counts, start, end = count_messages(self.messages())
        types = {
            c.topic: self._schemas[c.schema_id].name
            for c in self._channels.values()
            if c.schema_id in self._schemas
        }
        return Extent(types, counts, start, end)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Messages in the order of their chunks, by time within each; None for all topics."""
        self.losses = []
        with open(self.path, "rb") as file:
            if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
                self.losses.append(f"{self.path.name}: no mcap file")
                return
            finished, size = False, self.path.stat().st_size
            while head := file.read(_RECORD.size):
                if len(head) < _RECORD.size:
                    break
                opcode, length = _RECORD.unpack(head)
                if opcode == Opcode.FOOTER:
                    finished = True
                    break
                there = min(length, size - file.tell())  # a damaged length leads anywhere
                if opcode == Opcode.CHUNK:
                    yield from self._chunk(file, there, length, topics)
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE):
                    message = self._record(opcode, file.read(there), topics)
                    if message is not None:
                        yield message
                else:
                    file.seek(there, 1)
            if not finished:
                self.losses.append(f"{self.path.name}: ends before its end mark (truncated)")

    def _chunk(
        self, file: BinaryIO, there: int, length: int, topics: Collection[str] | None
    ) -> Iterator[RawMessage]:
        where = file.tell()
        content = file.read(there)
        found: list[RawMessage] = []
        try:
            records, whole = _uncompressed(content, length)
            for opcode, payload in _records(records):
                message = self._record(opcode, payload, topics)
                if message is not None:
                    found.append(message)
        except _DAMAGE as error:
            whole = False
            text = f"{self.path.name}: damaged chunk at byte {where}: {error}"
            self.losses.append(text)
        else:
            if not whole:
                text = f"{self.path.name}: damaged chunk at byte {where} read in part"
                self.losses.append(text)
        yield from sorted(found, key=lambda message: message.received_ns)

    def _record(
        self, opcode: int, payload: bytes, topics: Collection[str] | None
    ) -> RawMessage | None:
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(BytesIO(payload)))
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(BytesIO(payload)))
                self._channels[channel.id] = channel
            elif opcode == Opcode.MESSAGE:
                channel_id, _, log_time, _ = _MESSAGE.unpack_from(payload)
                known = self._channels.get(channel_id)
                if known is not None and (topics is None or known.topic in topics):
                    return RawMessage(known.topic, log_time, payload[_MESSAGE.size :])
        except (*_DAMAGE, McapError, UnicodeDecodeError) as error:
            self.losses.append(f"{self.path.name}: damaged record: {error or 'cut short'}")
        return None


def _uncompressed(content: bytes, length: int) -> tuple[bytes, bool]:
    """Records of a chunk, and whether they are all there; a cut chunk gives its beginning."""
    _, _, size, checksum = _CHUNK.unpack_from(content)
    offset = _CHUNK.size
    (name_length,) = struct.unpack_from("<I", content, offset)
    compression = content[offset + 4 : offset + 4 + name_length].decode()
    data = content[offset + 4 + name_length + 8 :]
    if compression == "zstd":
        records = zstandard.ZstdDecompressor().decompressobj().decompress(data)
    elif compression == "lz4":
        records = lz4.frame.LZ4FrameDecompressor().decompress(data)
    elif compression == "":
        records = data
    else:
        msg = f"unknown compression {compression!r}"
        raise ValueError(msg)
    if len(content) < length or len(records) < size:
        return records, False
    if checksum and zlib.crc32(records) != checksum:
        msg = "wrong checksum"
        raise ValueError(msg)
    return records, True


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Whole records of a chunk; raises EOFError at one that leads beyond its end."""
    offset = 0
    while offset < len(data):
        if offset + _RECORD.size > len(data):
            msg = "a record is cut short"
            raise EOFError(msg)
        opcode, length = _RECORD.unpack_from(data, offset)
        offset += _RECORD.size
        if offset + length > len(data):
            msg = "a record is cut short"
            raise EOFError(msg)
        yield opcode, data[offset : offset + length]
        offset += length
