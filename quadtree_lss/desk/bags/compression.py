# SPDX-License-Identifier: Apache-2.0
"""Decompression with a size limit, because a few kilobytes can expand to gigabytes."""

from __future__ import annotations

import bz2
import sys
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

MAX_BYTES = 1 << 28
"""Limit of a message or chunk, bytes: a cloud of four million points has 200 MB."""
MAX_FILE_BYTES, MAX_RATIO = 1 << 30, 100
"""Limit of a decompressed file: the greater one of these bytes and this multiple of its size.
Clouds compress to about a third."""
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
DECOMPRESSORS: dict[str, Any] = {
    "zstd": zstd.ZstdDecompressor,
    "lz4": lz4.frame.LZ4FrameDecompressor,
    "bz2": bz2.BZ2Decompressor,
}


class DamagedError(ValueError):
    """A part of a bag cannot be read."""


def unpack(compression: str, data: bytes, size: int) -> bytes:
    """Decompress at most ``size`` bytes; fewer if the data are truncated. ``compression``: a key of
    `DECOMPRESSORS`, ``none`` or empty. Raises `DamagedError`."""
    if compression in ("", "none"):
        return data
    if compression not in DECOMPRESSORS:
        raise DamagedError(f"unknown compression {compression!r}")
    if size > MAX_BYTES:
        raise DamagedError(f"{size} bytes are declared, the limit is {MAX_BYTES}")
    try:
        out: bytes = DECOMPRESSORS[compression]().decompress(data, max_length=size)
    except (zstd.ZstdError, RuntimeError, OSError, ValueError, EOFError) as error:
        raise DamagedError(" ".join(str(error).split()) or type(error).__name__) from None
    return out


def plain_message(raw: bytes) -> bytes:
    """Return a serialised message, decompressed if necessary. Raises `DamagedError`."""
    return unpack("zstd", raw, MAX_BYTES) if raw[:4] == ZSTD_MAGIC else raw


def unpack_file(source: Path, target: Path) -> str:
    """Decompress a zstd file as far as possible; return the fault, or an empty string."""
    limit = max(MAX_FILE_BYTES, MAX_RATIO * source.stat().st_size)
    with zstd.open(source) as packed, target.open("wb") as plain:
        try:
            while block := packed.read1(1 << 20):
                plain.write(block)
                if plain.tell() > limit:
                    return f"expands to more than {limit} bytes: the rest is not read"
        except EOFError:
            return "compressed data end early (truncated)"
        except zstd.ZstdError as error:
            return str(error)
    return ""
