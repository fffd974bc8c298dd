# SPDX-License-Identifier: Apache-2.0
"""Arrays inside a page: columns one after the other, compressed, in base64."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

_NONE = {"u1": 0xFF, "u2": 0xFFFF}


class Columns:
    """Collects the columns of a page; what each call returns tells ``columns.js`` where it is."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._end = 0

    def quantised(self, values: ArrayLike, kind: str = "u2") -> dict[str, Any]:
        """Entry i is low + step · data[i]; the greatest number stands for NaN."""
        flat = np.asarray(values, dtype=np.float64).ravel()
        finite = np.isfinite(flat)
        low, high = (flat[finite].min(), flat[finite].max()) if finite.any() else (0.0, 0.0)
        top = _NONE[kind] - 1
        step = float(high - low) / top if high > low else 1.0
        data = np.full(flat.shape, _NONE[kind], dtype=f"<{kind}")
        data[finite] = np.rint((flat[finite] - low) / step)
        return {"low": float(low), "step": step, **self._add(data, kind)}

    def whole(self, values: NDArray[Any], kind: str) -> dict[str, Any]:
        """Integers as they are, kind ``u1``, ``u2`` or ``u4``."""
        return self._add(np.asarray(values).astype(f"<{kind}"), kind)

    def floats(self, values: NDArray[Any]) -> dict[str, Any]:
        """Single precision."""
        return self._add(np.asarray(values).astype("<f4"), "f4")

    def text(self) -> str:
        """All of them."""
        return compressed(b"".join(self._parts))

    def _add(self, data: NDArray[Any], kind: str) -> dict[str, Any]:
        start, raw = self._end, data.tobytes()
        padding = -len(raw) % 4  # so that every column can be looked at where it lies
        self._parts.append(raw + bytes(padding))
        self._end += len(raw) + padding
        return {"kind": kind, "at": start, "length": data.size}


def compressed(content: bytes) -> str:
    """As a page carries it; `inflate` of ``columns.js`` undoes it."""
    return base64.b64encode(zlib.compress(content, 9)).decode()
