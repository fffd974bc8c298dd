# SPDX-License-Identifier: Apache-2.0
"""Writes messages as the wire carries them, for those that hold thousands of nested ones.

A marker of a map has tens of thousands of ``Point`` and ``ColorRGBA`` objects; making and
serialising them through rclpy would hold up scans for a tenth of a second. A NumPy array has the
same bytes already.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray


class CdrWriter:
    """Little-endian CDR (version 1): every number is aligned to its size."""

    def __init__(self) -> None:
        self._parts: list[bytes] = [b"\x00\x01\x00\x00"]
        self._size = 0

    def numbers(self, code: str, *values: float) -> CdrWriter:
        """Numbers of one ``struct`` code, for instance ``i``, ``I``, ``d``, ``f`` or ``?``."""
        self._align(struct.calcsize(f"<{code}"))
        return self._append(struct.pack(f"<{len(values)}{code}", *values))

    def string(self, text: str) -> CdrWriter:
        """A string with its length and final zero."""
        content = text.encode() + b"\x00"
        return self.numbers("I", len(content))._append(content)

    def rows(self, values: NDArray[Any], code: str) -> CdrWriter:
        """A sequence of messages that consist of equal numbers: (N, k) with ``struct`` code."""
        self.numbers("I", len(values))
        if len(values):
            self._align(struct.calcsize(f"<{code}"))
            self._append(np.ascontiguousarray(values, dtype=f"<{code}").tobytes())
        return self

    def empty_sequence(self) -> CdrWriter:
        """A sequence without elements."""
        return self.numbers("I", 0)

    def bytes(self) -> bytes:
        """The message, ready to publish."""
        return b"".join(self._parts)

    def _align(self, size: int) -> None:
        self._append(b"\x00" * (-self._size % size))

    def _append(self, content: bytes) -> CdrWriter:
        self._parts.append(content)
        self._size += len(content)
        return self
