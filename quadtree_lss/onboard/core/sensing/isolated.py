# SPDX-License-Identifier: Apache-2.0
"""Isolated returns: noise, multipath, dust.

Returns are linked if they are neighbours within the gate; a return is isolated if fewer than
three hang together with it, itself included. So neither a single stray return stays nor two that
happen to meet, while the last return of a row needs no more than one good neighbour.

In an organised scan neighbours are the four pixels next to one and the distance is the difference
in range; otherwise all points are neighbours and the distance is that in space. The gate widens
to five times the scan's usual distance, the median of that to the second nearest neighbour: what
a coarse view of slanted ground needs. Scans of fewer than three returns are not judged.
"""

from __future__ import annotations

from functools import lru_cache

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Array, Ints

if not cython.compiled:
    from math import inf as INFINITY

#: The gate is at least so many usual distances.
WIDENING = 5.0
#: So many pixels tell the usual distance.
SAMPLED = 1024
#: Steps of the golden section take a sample from all over a scan, whatever raster that is in.
GOLDEN = 0.6180339887498949


def isolated_in_image(ranges: Array, gate: float) -> int:
    """Make the ranges (H, W) of isolated returns NaN, which means none; how many they were.

    Args:
        ranges: m.
        gate: m; 0 keeps every return.
    """
    pixels = np.empty(ranges.size, dtype=np.int32)
    few = pixels_with_few_links(ranges, gate, pixels) if gate > 0.0 else 0
    # A wider gate leaves no return alone that a narrower one does not.
    few = pixels_without_hold(ranges, gate, pixels[:few])
    if few == 0 or few < 3 and np.count_nonzero(ranges > 0.0) < 3:
        return 0
    sample = spread_over(ranges.size, min(ranges.size, SAMPLED))
    steps = np.empty(len(sample))
    limit = max(gate, WIDENING * median(steps[: second_steps(ranges, sample, steps)]))
    lonely = pixels[: pixels_without_hold(ranges, limit, pixels[:few])]
    ranges.reshape(-1)[lonely] = np.nan
    return len(lonely)


def median(values: Array) -> float:
    """The middle one of (N,), 0 if there is none."""
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle]) if len(values) else 0.0


@lru_cache(maxsize=16)
def spread_over(count: int, sample: int) -> Ints:
    """Places (sample,) among ``count``, ``sample`` at most, from all over them."""
    if sample == count:
        return np.arange(count, dtype=np.int32)
    return (np.arange(sample) * GOLDEN % 1.0 * count).astype(np.int32)


@cython.boundscheck(False)
def pixels_with_few_links(ranges: Array, limit: float, pixels: Ints) -> cython.Py_ssize_t:
    """Returns with fewer than two links: their places in (H, W) to ``pixels``, how many.

    In a row without a step beyond the limit only the first and the last pixel may be such.
    """
    cython.declare(row=cython.Py_ssize_t, column=cython.Py_ssize_t, linked=cython.Py_ssize_t)
    few: cython.Py_ssize_t = 0
    width: cython.Py_ssize_t = ranges.shape[1]
    with cython.nogil:
        for row in range(ranges.shape[0]):
            linked = 0
            for column in range(width - 1):
                linked += abs(ranges[row, column + 1] - ranges[row, column]) <= limit
            column = 0
            while column < width:
                if ranges[row, column] > 0.0 and pixel_links(ranges, row, column, limit) < 2:
                    pixels[few] = row * width + column
                    few += 1
                column += max(linked, 1) if linked == width - 1 else 1
    return few


@cython.boundscheck(False)
def pixels_without_hold(ranges: Array, limit: float, pixels: Ints) -> cython.Py_ssize_t:
    """Those of ``pixels`` (M,) that are isolated, to the front of them; how many."""
    i: cython.Py_ssize_t
    lonely: cython.Py_ssize_t = 0
    width: cython.Py_ssize_t = ranges.shape[1]
    with cython.nogil:
        for i in range(pixels.shape[0]):
            if not pixel_holds(ranges, pixels[i] // width, pixels[i] % width, limit):
                pixels[lonely] = pixels[i]
                lonely += 1
    return lonely


def pixel_holds(
    ranges: Array, row: cython.Py_ssize_t, column: cython.Py_ssize_t, limit: float
) -> cython.bint:
    """True if a return is linked with two others, or with one that is linked with two."""
    links: cython.Py_ssize_t = 0
    cython.declare(k=cython.Py_ssize_t, r=cython.Py_ssize_t, c=cython.Py_ssize_t)
    for k in range(4):
        if step_to(ranges, row, column, k) <= limit:
            links += 1
            r = row + (k == 2) - (k == 3)
            c = column + (k == 0) - (k == 1)
            if links == 2 or pixel_links(ranges, r, c, limit) == 2:
                return True
    return False


def pixel_links(
    ranges: Array, row: cython.Py_ssize_t, column: cython.Py_ssize_t, limit: float
) -> cython.Py_ssize_t:
    """With how many of the four next to it a pixel is linked, counted to two."""
    links: cython.Py_ssize_t = 0
    k: cython.Py_ssize_t
    for k in range(4):
        links += step_to(ranges, row, column, k) <= limit
        if links == 2:
            break
    return links


@cython.boundscheck(False)
def step_to(
    ranges: Array, row: cython.Py_ssize_t, column: cython.Py_ssize_t, k: cython.Py_ssize_t
) -> float:
    """Range difference of a pixel to the k-th of the four next to it; infinite if there is none."""
    r: cython.Py_ssize_t = row + (k == 2) - (k == 3)
    c: cython.Py_ssize_t = column + (k == 0) - (k == 1)
    step: float = INFINITY
    if 0 <= r < ranges.shape[0] and 0 <= c < ranges.shape[1]:
        step = abs(ranges[r, c] - ranges[row, column])
    return step


@cython.boundscheck(False)
def second_steps(ranges: Array, pixels: Ints, steps: Array) -> cython.Py_ssize_t:
    """Second least step from each of ``pixels`` (M,) to those next to it, to ``steps`` (M,), m;
    how many of them have two neighbours."""
    cython.declare(i=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(row=cython.Py_ssize_t, column=cython.Py_ssize_t)
    known: cython.Py_ssize_t = 0
    with cython.nogil:
        for i in range(pixels.shape[0]):
            least = INFINITY
            second = INFINITY
            row = pixels[i] // ranges.shape[1]
            column = pixels[i] - row * ranges.shape[1]
            for k in range(4):
                step = step_to(ranges, row, column, k)
                if step < least:
                    second = least
                    least = step
                elif step < second:
                    second = step
            if second < INFINITY:
                steps[known] = second
                known += 1
    return known
