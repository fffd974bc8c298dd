# SPDX-License-Identifier: Apache-2.0
"""Morton codes of cells, in whose order the points of each cell of each level are contiguous."""

from __future__ import annotations

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Index, Keys


def encode(ix: cython.longlong, iy: cython.longlong) -> cython.longlong:
    """Return the Morton code of the cell (ix, iy), each below 2^16: ix in the even bits."""
    return spread(ix) | (spread(iy) << 1)


def spread(value: cython.longlong) -> cython.longlong:
    """Move the bits of a number below 2^16 to the even positions."""
    value = (value | (value << 8)) & 0x00FF00FF
    value = (value | (value << 4)) & 0x0F0F0F0F
    value = (value | (value << 2)) & 0x33333333
    return (value | (value << 1)) & 0x55555555


def compact(code: cython.longlong) -> cython.longlong:
    """Return the even bits of a code below 2^32 as one number, the inverse of `spread`."""
    code = code & 0x55555555
    code = (code | (code >> 1)) & 0x33333333
    code = (code | (code >> 2)) & 0x0F0F0F0F
    code = (code | (code >> 4)) & 0x00FF00FF
    return (code | (code >> 8)) & 0x0000FFFF


def decode(codes: Keys) -> tuple[Index, Index]:
    """Return ix and iy, each (N,), of Morton codes (N,)."""
    found = []
    for value in (codes, codes >> 1):
        value = value & 0x55555555
        for shift, mask in ((1, 0x33333333), (2, 0x0F0F0F0F), (4, 0x00FF00FF), (8, 0x0000FFFF)):
            value = (value | (value >> shift)) & mask
        found.append(value.astype(np.intp))
    return found[0], found[1]


#: `spread` of 0 … 4095, a lookup table for loops over points.
SPREAD = np.array([spread(value) for value in range(4096)], dtype=np.int64)
