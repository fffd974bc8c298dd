# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False
"""Kernels over the points of a scan: rotation to map axes, cell lookup, sorting by cell."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cython
import numpy as np
from cython.cimports.libc.math import INFINITY, NAN, sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry.morton import PLACE_BITS, prefetch

from quadtree_lss.onboard.arrays import Array, Ints, Keys, Points
from quadtree_lss.onboard.config.settings import LidarConfig
from quadtree_lss.onboard.core.geometry.morton import SPREAD, sort_packed

if TYPE_CHECKING:
    from quadtree_lss.onboard.core.tree.domain import Domain

#: As a typed view.
SPREAD_VIEW = cython.declare(cython.longlong[::1], SPREAD)


class Workspace:
    """N points of a scan in map axes, in the order of the scan. The next scan of equal size uses
    the same memory, because allocation is as slow as the kernels.

    Attributes:
        points: (N + 3, 3) about the lidar, m; undefined where there is no return.
        ranges: (N,) m, NaN where there is no return.
        runs: (N,) runs of consecutive points in the same finest cell: its Morton code (``count``
            squared outside the domain) and the number of the run in the bits below `PLACE_BITS`.
        begins: (N + 1,) the first point of each run, and the end of the last.
        run_count: Number of runs.
        missing, beyond: Number of points that are not finite, and of those out of range.
        above: Whether a point in a cell lies above the lidar.
    """

    def __init__(self) -> None:
        self.size = -1
        self.missing = self.beyond = self.run_count = 0
        self.above = False

    def resize(self, size: cython.Py_ssize_t) -> None:
        """Allocate memory for scans of ``size`` points."""
        if size != self.size:
            self.size = size
            self.points, self.ranges = np.empty((size + 3, 3)), np.empty(size)
            self.runs, self.spare = np.empty((2, size), np.int64)
            self.begins = np.empty(size + 1, np.int32)


def transform_points(
    points_lidar: Points,
    offsets: Ints,
    times: Array,
    motion: Array,
    lidar: LidarConfig,
    domain: Domain,
    position: Array,
    work: Workspace,
) -> cython.void:
    """Rotate points (N, 3) to map axes, about the lidar at the scan's stamp, m; find their cells.

    ``offsets``, ``times`` and ``motion`` are those of a `sweep.Sweep`; without offsets, or if all
    times are equal, the first row of ``motion`` applies to all points. ``position``: (3,) of the
    lidar at the scan's stamp, map frame, m. ``work``: receives the results.
    """
    i: cython.Py_ssize_t
    missing: cython.longlong = 0
    beyond: cython.longlong = 0
    highest: cython.double = -INFINITY
    cython.declare(x=cython.double, y=cython.double, z=cython.double, k=cython.Py_ssize_t)
    at: cython.Py_ssize_t = 0
    run: cython.Py_ssize_t = -1
    last: cython.longlong = -1
    cython.declare(code=cython.longlong)
    count: cython.longlong = 1 << domain.max_level
    nowhere: cython.longlong = count * count
    side: cython.double = count
    per_metre: cython.double = count / domain.size
    west: cython.double = position[0] - domain.xmin
    south: cython.double = position[1] - domain.ymin
    max_range: cython.double = lidar.max_range
    moving: cython.bint = offsets.shape[0] > 0 and times[0] < times[times.shape[0] - 1]
    nearest: cython.double = max(lidar.min_range, 5e-324)  # greater than 0
    r = cython.declare(cython.double[12])
    points = cython.declare(cython.double[:, ::1], work.points)
    ranges = cython.declare(cython.double[::1], work.ranges)
    runs = cython.declare(cython.longlong[::1], work.runs)
    begins = cython.declare(cython.int[::1], work.begins)
    spread = cython.declare(cython.longlong[::1], SPREAD_VIEW)
    begins[0] = 0
    with cython.nogil:
        for k in range(12):
            r[k] = motion[0, k]
        for i in range(points_lidar.shape[0]):
            x = points_lidar[i, 0]
            y = points_lidar[i, 1]
            z = points_lidar[i, 2]
            distance = sqrt(x * x + y * y + z * z)
            code = nowhere
            if nearest <= distance <= max_range:
                ranges[i] = distance
                if moving:
                    while at > 0 and offsets[i] < times[at]:
                        at -= 1
                    while at < times.shape[0] - 2 and offsets[i] >= times[at + 1]:
                        at += 1
                    share = (offsets[i] - times[at]) / (times[at + 1] - times[at])
                    for k in range(12):
                        r[k] = motion[at, k] + share * (motion[at + 1, k] - motion[at, k])
                up = r[6] * x + r[7] * y + r[8] * z + r[11]
                points[i, 2] = up
                east = r[0] * x + r[1] * y + r[2] * z + r[9]
                north = r[3] * x + r[4] * y + r[5] * z + r[10]
                points[i, 0] = east
                points[i, 1] = north
                column = (east + west) * per_metre
                row = (north + south) * per_metre
                if 0.0 <= column < side and 0.0 <= row < side:
                    code = spread[cython.cast(cython.Py_ssize_t, column)]
                    code |= spread[cython.cast(cython.Py_ssize_t, row)] << 1
                    highest = highest if highest > up else up
            else:
                ranges[i] = NAN
                # The square of a finite coordinate can overflow.
                if x - x + (y - y) + (z - z) == 0.0:
                    beyond += 1
                else:
                    missing += 1
            # Branch-free: mispredictions are costly here.
            run += code != last
            last = code
            runs[run] = (code << PLACE_BITS) | run
            begins[run + 1] = i + 1
    work.missing = missing
    work.beyond = beyond
    work.run_count = run + 1
    work.above = highest > 0.0


def sort_points(
    work: Workspace, isolated: cython.bint, nowhere: cython.longlong
) -> tuple[Array, Keys]:
    """Sort the runs; return points (M, 3) and their keys (M,), run by run.

    At least four points of a run are copied, without a branch on its length; the next run
    overwrites the excess. Points outside the domain (key ``nowhere``) are dropped, and with
    ``isolated`` those without a range.
    """
    four = cython.declare(cython.double[12])
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, run=cython.Py_ssize_t)
    cython.declare(begin=cython.Py_ssize_t, end=cython.Py_ssize_t, at=cython.Py_ssize_t)
    key: cython.longlong
    ahead: cython.longlong
    to: cython.Py_ssize_t = 0
    runs = cython.declare(cython.longlong[::1], work.runs[: work.run_count])
    spare = cython.declare(cython.longlong[::1], work.spare[: work.run_count])
    if sort_packed(runs, spare):
        runs = spare
    points = cython.declare(cython.p_double, cython.address(work.points[0, 0]))
    ranges = cython.declare(cython.double[::1], work.ranges)
    begins = cython.declare(cython.int[::1], work.begins)
    size: cython.Py_ssize_t = work.points.shape[0]
    sorted_points, sorted_keys = np.empty((size, 3)), np.empty(size, np.int64)
    arranged = cython.declare(cython.double[::1], sorted_points.reshape(-1))
    keys = cython.declare(cython.longlong[::1], sorted_keys)
    with cython.nogil:
        for i in range(runs.shape[0]):
            key = runs[i] >> PLACE_BITS
            if key == nowhere:
                break
            run = runs[i] - (key << PLACE_BITS)
            # Runs are scattered over the scan: prefetch a later one.
            ahead = runs[min(i + 16, runs.shape[0] - 1)]
            ahead -= (ahead >> PLACE_BITS) << PLACE_BITS
            prefetch(cython.address(points[3 * begins[ahead]]))
            begin, end = begins[run], begins[run + 1]
            if isolated:
                for at in range(begin, end):
                    if ranges[at] > 0.0:
                        for j in range(3):
                            arranged[3 * to + j] = points[3 * at + j]
                        keys[to] = key
                        to += 1
                continue
            for j in range(12):
                four[j] = points[3 * begin + j]
            for j in range(12):
                arranged[3 * to + j] = four[j]
            for j in range(4):
                keys[to + j] = key
            if end - begin > 4:
                for j in range(12, 3 * (end - begin)):
                    arranged[3 * to + j] = points[3 * begin + j]
                for j in range(4, end - begin):
                    keys[to + j] = key
            to += end - begin
    return sorted_points[:to], sorted_keys[:to]
