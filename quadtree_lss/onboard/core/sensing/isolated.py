# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False
"""Detection of isolated returns: noise, multipath, dust.

Two neighbouring returns are linked if their distance is within the gate. A return is isolated if
its group of linked returns has fewer than three members.

In an organised scan, neighbours are the four adjacent pixels and the distance is the difference in
range. In an unorganised scan, all points are neighbours and the distance is Euclidean. The gate is
at least `GATE_FACTOR` times the scan's typical distance (the median distance to the second nearest
neighbour). Scans of fewer than three returns are not filtered.
"""

from __future__ import annotations

from typing import Any

import cython
import numpy as np
from cython.cimports.libc.math import INFINITY

from quadtree_lss.onboard.arrays import Array, Ints, Mask

#: Least gate in typical distances. Returns of a slanted plane at 400 m differ by one typical
#: distance, those of rocks and noisy pixels by a multiple.
GATE_FACTOR = 5.0
#: Indices, as shares of the number of points, at which the typical distance is sampled: multiples
#: of the golden section sample any raster evenly.
SAMPLE = np.arange(1024) * 0.6180339887498949 % 1.0
#: Least gate of an unorganised scan, m: equal points are linked.
MIN_GATE = 1e-6


def isolated_in_image(ranges: Array, gate: float) -> Ints:
    """Find the isolated returns of an organised scan: flat indices (K,), ascending.

    ``ranges``: (H, W), m; NaN where there is no return. ``gate``: m; 0 keeps every return.
    """
    pixels = np.empty(ranges.size, dtype=np.int32)
    count = find_isolated(ranges, gate, pixels) if gate > 0.0 else 0
    if count == 0 or np.count_nonzero(ranges > 0.0) < 3:
        return pixels[:0]
    steps = np.empty(len(SAMPLE))
    known = second_steps(ranges, (SAMPLE * ranges.size).astype(np.int32), steps)
    if known:
        gate = max(gate, GATE_FACTOR * float(np.partition(steps[:known], known // 2)[known // 2]))
    return pixels[: find_isolated(ranges, gate, pixels)]


@cython.locals(ranges=cython.double[:, ::1], pixels=cython.int[::1])
def find_isolated(ranges: Array, limit: float, pixels: Ints) -> cython.Py_ssize_t:
    """Write flat indices of isolated returns of an image (H, W) to ``pixels``; return their number.

    In a row without a step beyond the limit only the first and the last pixel can be isolated.
    """
    cython.declare(row=cython.Py_ssize_t, column=cython.Py_ssize_t, linked=cython.Py_ssize_t)
    count: cython.Py_ssize_t = 0
    width: cython.Py_ssize_t = ranges.shape[1]
    with cython.nogil:
        for row in range(ranges.shape[0]):
            linked = 0
            for column in range(width - 1):
                step = abs(ranges[row, column + 1] - ranges[row, column])
                link = 1.0 if step <= limit else 0.0  # a float, so that the loop vectorises
                linked += cython.cast(cython.int, link)
            column = 0
            while column < width:
                if ranges[row, column] > 0.0 and is_isolated(ranges, row, column, limit):
                    pixels[count] = row * width + column
                    count += 1
                column += max(linked, 1) if linked == width - 1 else 1
    return count


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(ranges=cython.double[:, ::1])
def is_isolated(
    ranges: Array, row: cython.Py_ssize_t, column: cython.Py_ssize_t, limit: float
) -> cython.bint:
    """Return whether a pixel has neither two links nor one to a pixel with two."""
    for _ in range(2):
        sides: cython.int = links(ranges, row, column, limit)
        if sides & (sides - 1) != 0:
            return False
        row += (sides == 4) - (sides == 8)
        column += (sides == 1) - (sides == 2)
    return True


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(ranges=cython.double[:, ::1])
def links(
    ranges: Array, row: cython.Py_ssize_t, column: cython.Py_ssize_t, limit: float
) -> cython.int:
    """Return the first two links of a pixel as bits: 1 right, 2 left, 4 below, 8 above."""
    side: cython.Py_ssize_t
    found: cython.int = 0
    for side in range(4):
        if step_to(ranges, row, column, side) <= limit:
            if found:
                return found | 1 << side
            found = 1 << side
    return found


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
@cython.locals(ranges=cython.double[:, ::1])
def step_to(
    ranges: Array, row: cython.Py_ssize_t, column: cython.Py_ssize_t, side: cython.Py_ssize_t
) -> float:
    """Return the range difference to an adjacent pixel, m; infinite beyond the image's border.
    ``side``: 0 right, 1 left, 2 below, 3 above."""
    r: cython.Py_ssize_t = row + (side == 2) - (side == 3)
    c: cython.Py_ssize_t = column + (side == 0) - (side == 1)
    step: float = INFINITY
    if 0 <= r < ranges.shape[0] and 0 <= c < ranges.shape[1]:
        step = abs(ranges[r, c] - ranges[row, column])
    return step


@cython.locals(ranges=cython.double[:, ::1], pixels=cython.int[::1], steps=cython.double[::1])
def second_steps(ranges: Array, pixels: Ints, steps: Array) -> cython.Py_ssize_t:
    """Write the second smallest step from each of ``pixels`` (M,) to its neighbours to ``steps``
    (M,), m; skip pixels with fewer than two neighbours. Return the number of steps."""
    cython.declare(i=cython.Py_ssize_t, side=cython.Py_ssize_t)
    known: cython.Py_ssize_t = 0
    width: cython.Py_ssize_t = ranges.shape[1]
    with cython.nogil:
        for i in range(pixels.shape[0]):
            least = second = INFINITY
            for side in range(4):
                step = step_to(ranges, pixels[i] // width, pixels[i] % width, side)
                if step < second:
                    second = max(step, least)
                    least = min(step, least)
            if second < INFINITY:
                steps[known] = second
                known += 1
    return known


def isolated_in_space(points: Array, ranges: Array, gate: float) -> Ints:
    """Find the isolated returns of an unorganised scan: indices (K,), ascending.

    ``points``: (N, 3) in any axes, m; ``ranges`` and ``gate`` as of `isolated_in_image`.
    """
    returns = np.flatnonzero(ranges > 0.0).astype(np.int32)
    if gate == 0.0 or len(returns) < 3:
        return returns[:0]
    points = points[returns]
    linked = linked_in_order(points, gate)
    if linked.all():
        return returns[:0]
    from scipy.spatial import cKDTree  # the import takes 0.5 s, not needed for organised scans

    limit = max(gate, GATE_FACTOR * typical_distance(points), MIN_GATE)
    tree: Any = cKDTree(points, leafsize=32, compact_nodes=False, balanced_tree=False)
    apart = tree.indices[~linked[tree.indices]]  # queries in the tree's order are faster
    distance, near = tree.query(points[apart], k=3, distance_upper_bound=limit)
    kept = np.isfinite(distance[:, 2])
    pair = np.flatnonzero(np.isfinite(distance[:, 1]) & ~kept)
    other = near[pair, :2].sum(axis=1) - apart[pair]  # the point itself is one of the two
    kept[pair] = np.isfinite(tree.query(points[other], k=[3], distance_upper_bound=limit)[0][:, 0])
    isolated: Ints = np.sort(returns[apart[~kept]])
    return isolated


def typical_distance(points: Array) -> float:
    """Estimate the median distance of points (N, 3) to their second nearest neighbour, m, from a
    sample: on a surface, one point in k has sqrt(k) times the distance."""
    from scipy.spatial import cKDTree

    sample = points[np.unique((SAMPLE[:256] * len(points)).astype(np.intp))]
    distance = np.median(cKDTree(sample).query(sample, k=[3])[0])
    return float(distance * np.sqrt(1.0 * len(sample) / len(points)))


def linked_in_order(points: Array, limit: float) -> Mask:
    """Return a mask (N,) of points linked to two of their four neighbours in the scan's order."""
    links = np.zeros(len(points), dtype=np.uint8)
    for step in (1, 2):
        difference = points[step:] - points[:-step]
        near = np.einsum("ij,ij->i", difference, difference) <= limit * limit
        links[step:] += near
        links[:-step] += near
    linked: Mask = links >= 2
    return linked
