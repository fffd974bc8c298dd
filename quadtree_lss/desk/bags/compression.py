# SPDX-License-Identifier: Apache-2.0
"""Decompression within bounds: a few kilobytes can claim to be gigabytes."""

from __future__ import annotations

import bz2
import itertools
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard

MOST_BYTES = 1 << 28
"""Of one message or one chunk of messages; a cloud of four million points has 200 MB."""
FREE_BYTES, MOST_RATIO = 1 << 30, 100
"""A file compressed as a whole may unpack to so much, and to so many times its size: clouds are
packed to a third."""
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_PIECE = 1 << 20


class DamagedError(ValueError):
    """Something of a bag cannot be read; says what, without where."""


def unpack(compression: str, data: bytes, size: int) -> bytes:
    """Content of compressed data, or its beginning if they are cut. ``compression``: ``zstd``,
    ``lz4``, ``bz2``, or ``none`` or empty. ``data``: what is there. ``size``: bytes it may have.
    Raises `DamagedError`: damaged, larger than ``size``, or that is more than can be read."""
    if size > MOST_BYTES:
        raise DamagedError(f"claims {size} bytes, {MOST_BYTES} is the most")
    try:
        out = _content(compression, data, size)
    except (zstandard.ZstdError, RuntimeError, OSError, ValueError, EOFError) as error:
        raise DamagedError(" ".join(str(error).split()) or type(error).__name__) from None
    if len(out) > size:
        raise DamagedError(f"holds more than the {size} bytes it claims")
    return out


def plain_message(raw: bytes) -> bytes:
    """A serialised message, which bags may compress each by itself. Raises `DamagedError`."""
    return unpack("zstd", raw, MOST_BYTES) if raw[:4] == ZSTD_MAGIC else raw


def _content(compression: str, data: bytes, most: int) -> bytes:
    """No more than a piece beyond ``most``."""
    if compression in ("", "none"):
        return data
    if compression == "zstd":
        reader = zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True)
        pieces = iter(lambda: reader.read(_PIECE), b"")
        return b"".join(itertools.islice(pieces, most // _PIECE + 1))
    if compression == "lz4":
        out: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=most + 1)
        return out
    if compression == "bz2":
        return bz2.BZ2Decompressor().decompress(data, max_length=most + 1)
    raise DamagedError(f"unknown compression {compression!r}")


def unpack_file(source: BinaryIO, target: BinaryIO) -> str | None:
    """A file that was compressed with zstd as a whole, as far as it can be read. Returns what is
    wrong with it, None if nothing is."""
    decompressor = zstandard.ZstdDecompressor().decompressobj()
    packed = unpacked = 0
    try:
        while block := source.read(1 << 11):  # of which no more than 64 MB can come
            packed += len(block)
            content = decompressor.decompress(block)
            unpacked += len(content)
            target.write(content)
            if unpacked > max(FREE_BYTES, MOST_RATIO * packed):
                return f"unpacks to more than {unpacked / packed:.0f} times its size: not read on"
    except zstandard.ZstdError as error:
        return f"{error}"
    return None if decompressor.eof else "compressed data end early (truncated)"
