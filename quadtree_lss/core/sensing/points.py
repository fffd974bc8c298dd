# SPDX-License-Identifier: Apache-2.0
"""Passes over the points of a scan: to map axes, into cells, into the order of the cells."""

from __future__ import annotations

import cython

from quadtree_lss.arrays import Array, Ints, Keys, Points

if not cython.compiled:
    from math import nan as NAN
    from math import sqrt

    from quadtree_lss.core.geometry.morton import PLACE_BITS, PLACE_MASK


@cython.boundscheck(False)
def turn(
    points_lidar: Points,
    offsets: Ints,
    times: Array,
    motion: Array,
    least: float,
    most: float,
    points: Array,
    ranges: Array,
    lost: Keys,
) -> cython.void:
    """Turn points (N, 3) to map axes, about the lidar at the scan's stamp, m.

    Args:
        offsets, times, motion: Of a `sweep.Sweep`; without offsets, the first row is for all.
        least, most: Shorter or longer ranges are no returns, m.
        points: (N, 3) for the answer.
        ranges: (N,) for their ranges, NaN where there is no return.
        lost: (2,) for how many are not finite, and how many are out of range.
    """
    i: cython.Py_ssize_t
    missing: cython.longlong = 0
    beyond: cython.longlong = 0
    cython.declare(x=cython.double, y=cython.double, z=cython.double, k=cython.Py_ssize_t)
    row: cython.Py_ssize_t = 0
    moving: cython.bint = offsets.shape[0] > 0
    r = cython.declare(cython.double[12])
    with cython.nogil:
        for k in range(12):
            r[k] = motion[0, k]
        for i in range(points_lidar.shape[0]):
            x = points_lidar[i, 0]
            y = points_lidar[i, 1]
            z = points_lidar[i, 2]
            distance = sqrt(x * x + y * y + z * z)
            if distance > 0.0 and least <= distance <= most:
                ranges[i] = distance
                if moving:
                    while row > 0 and offsets[i] < times[row]:
                        row -= 1
                    while row < times.shape[0] - 2 and offsets[i] >= times[row + 1]:
                        row += 1
                    share = (offsets[i] - times[row]) / (times[row + 1] - times[row])
                    for k in range(12):
                        r[k] = motion[row, k] + share * (motion[row + 1, k] - motion[row, k])
                points[i, 0] = r[0] * x + r[1] * y + r[2] * z + r[9]
                points[i, 1] = r[3] * x + r[4] * y + r[5] * z + r[10]
                points[i, 2] = r[6] * x + r[7] * y + r[8] * z + r[11]
            else:
                ranges[i] = NAN
                # The square of an absurd coordinate may be infinite though it is not.
                if x - x + (y - y) + (z - z) == 0.0:
                    beyond += 1
                else:
                    missing += 1
    lost[0] = missing
    lost[1] = beyond


@cython.boundscheck(False)
def reach_beyond(points: Points, limit: float) -> cython.bint:
    """True if one of points (N, 3) has a coordinate beyond ``limit`` or infinite."""
    i: cython.Py_ssize_t
    with cython.nogil:
        for i in range(points.shape[0]):
            if abs(points[i, 0]) > limit or abs(points[i, 1]) > limit or abs(points[i, 2]) > limit:
                return True
    return False


@cython.boundscheck(False)
def bin_runs(
    points: Array,
    ranges: Array,
    west: float,
    south: float,
    per_metre: float,
    count: cython.longlong,
    spread: Keys,
    runs: Keys,
    spans: Ints,
    found: Keys,
    sums: Array,
) -> cython.void:
    """Find the finest cell under each point (N, 3) that has a range (N,).

    Points in the same cell that follow one another are a run.

    Args:
        west, south: Place of the points' origin in the domain, from its corner, m.
        per_metre, count: Finest cells to a metre, and along a side.
        spread: `morton.SPREAD`.
        runs: (N,) for the cell's Morton code and the number of each run, packed as
            `morton.sort_packed` needs them.
        spans: (N, 2) for the first point of each run and the one behind its last.
        found: (2,) for how many points lie inside the domain, and in how many runs.
        sums: (2,) for the sums of x and y of all points, those outside included, m.
    """
    i: cython.Py_ssize_t
    inside: cython.Py_ssize_t = 0
    run: cython.Py_ssize_t = -1
    first: cython.Py_ssize_t = 0
    cython.declare(new=cython.Py_ssize_t, key=cython.longlong)
    last: cython.longlong = -1
    sum_x = 0.0
    sum_y = 0.0
    with cython.nogil:
        for i in range(points.shape[0]):
            if not ranges[i] > 0.0:
                last = -1
                continue
            sum_x += points[i, 0]
            sum_y += points[i, 1]
            column = (points[i, 0] + west) * per_metre
            row = (points[i, 1] + south) * per_metre
            if not (0.0 <= column < count and 0.0 <= row < count):
                last = -1
                continue
            key = spread[cython.cast(cython.Py_ssize_t, column)]
            key |= spread[cython.cast(cython.Py_ssize_t, row)] << 1
            # Without a branch, which nobody could foretell.
            new = key != last
            run += new
            first += new * (i - first)
            last = key
            runs[run] = (key << PLACE_BITS) | run
            spans[run, 0] = first
            spans[run, 1] = i + 1
            inside += 1
    found[0] = inside
    found[1] = run + 1
    sums[0] = sum_x
    sums[1] = sum_y


@cython.boundscheck(False)
def arrange(points: Array, runs: Keys, spans: Ints, arranged: Array, keys: Keys) -> cython.void:
    """Copy points run by run to ``arranged`` (M, 3), the key of each to ``keys`` (M,).

    Args:
        runs, spans: As of `bin_runs`, ``runs`` sorted.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, run=cython.Py_ssize_t)
    to: cython.Py_ssize_t = 0
    with cython.nogil:
        for i in range(runs.shape[0]):
            run = runs[i] & PLACE_MASK
            for j in range(spans[run, 0], spans[run, 1]):
                arranged[to, 0] = points[j, 0]
                arranged[to, 1] = points[j, 1]
                arranged[to, 2] = points[j, 2]
                keys[to] = runs[i] >> PLACE_BITS
                to += 1
