# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False
"""Morton codes of cells, in whose order the points of each cell of each level are contiguous."""

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.quadtree_lss.onboard.core.geometry.morton import DIGIT_BITS, PLACE_BITS

from quadtree_lss.onboard.arrays import Keys


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


#: `spread` of 0 … 4095, a lookup table for loops over points.
SPREAD = np.array([spread(value) for value in range(4096)], dtype=np.int64)


def sort_packed(packed: Keys, spare: Keys) -> cython.bint:
    """Sort numbers (N,) by their key, the bits from ``PLACE_BITS`` on: a stable radix sort.

    Only the bits that differ between the keys are divided into digits. Returns True if the sorted
    numbers are in ``spare`` (N,), False if they are in ``packed``.
    """
    i: cython.Py_ssize_t
    low: cython.longlong = PLACE_BITS
    width: cython.longlong = 0
    ones: cython.longlong = 0
    zeros: cython.longlong = 0
    cython.declare(differing=cython.longlong, digit=cython.longlong, passes=cython.longlong)
    cython.declare(k=cython.longlong)
    if packed.shape[0] == 0:
        return False
    with cython.nogil:
        for i in range(packed.shape[0]):
            ones |= packed[i]
            zeros |= ~packed[i]
        differing = (ones & zeros) >> PLACE_BITS
        while differing > 0 and differing & 1 == 0:
            differing >>= 1
            low += 1
        while differing > 0:
            differing >>= 1
            width += 1
        passes = (width + DIGIT_BITS - 1) // DIGIT_BITS
        digit = (width + passes - 1) // passes if passes > 0 else 0
        for k in range(passes):
            if k & 1 == 0:
                sort_by_digit(packed, spare, low + k * digit, 1 << digit)
            else:
                sort_by_digit(spare, packed, low + k * digit, 1 << digit)
    return passes & 1 == 1


def sort_by_digit(
    source: Keys, target: Keys, low: cython.longlong, count: cython.longlong
) -> cython.void:
    """Copy ``source`` to ``target`` in the order of the digit at bit ``low`` (``count`` values)."""
    cython.declare(i=cython.Py_ssize_t, digit=cython.longlong)
    before: cython.longlong = 0
    here: cython.longlong
    first = cython.declare(cython.int[2048])
    for digit in range(count):
        first[digit] = 0
    for i in range(source.shape[0]):
        first[(source[i] >> low) & (count - 1)] += 1
    for digit in range(count):
        here = first[digit]
        first[digit] = before
        before += here
    for i in range(source.shape[0]):
        digit = (source[i] >> low) & (count - 1)
        target[first[digit]] = source[i]
        first[digit] += 1
