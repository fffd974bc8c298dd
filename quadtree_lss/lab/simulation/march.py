# SPDX-License-Identifier: Apache-2.0
"""Ray casting on a bilinear heightfield, compiled.

Horizontal coordinates count posts. A ray above the highest post of the window around it advances
to that height or to the edge of the window. Close to the ground it advances cell by cell; within a
cell the height above the bilinear surface is a quadratic of the range, whose first root is the hit.
"""

from __future__ import annotations

import cython
from cython.cimports.libc.math import INFINITY, NAN, fabs, sqrt

from quadtree_lss.onboard.arrays import Array

#: Advance past the edge of a cell, posts, so that the next position is in the next cell.
NUDGE = cython.declare(cython.double, 1e-7)


@cython.boundscheck(False)
@cython.locals(elevation=cython.double[:, ::1], far=cython.double[:, ::1])
@cython.locals(middle=cython.double[:, ::1], near=cython.double[:, ::1], box=cython.double[::1])
@cython.locals(start=cython.double[::1], speed=cython.double[:, ::1], ranges=cython.double[::1])
def march(
    elevation: Array,
    far: Array,
    middle: Array,
    near: Array,
    box: Array,
    start: Array,
    speed: Array,
    ranges: Array,
) -> None:
    """Set ``ranges`` (N,) to the first hit on the ``elevation`` (ny, nx), NaN without one.

    The rays start at ``start`` (3,) and move by ``speed`` (N, 3) per unit of range: posts, posts,
    m. ``far``, ``middle``, ``near``: highest post within one window of each block of 64, 16 and 4
    posts; ``box`` (2,): heights of the lowest and of the highest post.
    """
    cython.declare(k=cython.Py_ssize_t, i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    cython.declare(axis=cython.Py_ssize_t, entering=cython.bint)
    cython.declare(x=cython.double, y=cython.double, z=cython.double)
    cython.declare(vx=cython.double, vy=cython.double, vz=cython.double)
    cython.declare(t=cython.double, end=cython.double, low=cython.double, high=cython.double)
    ny: cython.Py_ssize_t = elevation.shape[0]
    nx: cython.Py_ssize_t = elevation.shape[1]
    with cython.nogil:
        for k in range(ranges.shape[0]):
            ranges[k] = NAN
            vx, vy, vz = speed[k, 0], speed[k, 1], speed[k, 2]
            # Range interval over the posts and between the lowest and the highest one.
            t, end = 0.0, INFINITY
            for axis in range(3):
                low = 0.0 if axis < 2 else box[0] - 1e-6
                high = (nx - 1.0) if axis == 0 else (ny - 1.0) if axis == 1 else box[1] + 1e-6
                x, y = start[axis], speed[k, axis]
                if y == 0.0:
                    if not low <= x <= high:
                        end = -INFINITY
                    continue
                low, high = (low - x) / y, (high - x) / y
                if low > high:
                    low, high = high, low
                t = low if low > t else t
                end = high if high < end else end
            if not end > t or end == INFINITY:
                continue
            per_post = INFINITY if vx == 0.0 and vy == 0.0 else 1.0 / max(fabs(vx), fabs(vy))
            per_height = -1.0 / vz if vz < 0.0 else INFINITY
            entering = True
            while True:
                x, y, z = start[0] + t * vx, start[1] + t * vy, start[2] + t * vz
                i = min(max(cython.cast(cython.Py_ssize_t, x), 0), nx - 1)
                j = min(max(cython.cast(cython.Py_ssize_t, y), 0), ny - 1)
                step = free_range(z - far[j // 64, i // 64], 64.0, per_post, per_height)
                step = max(
                    step, free_range(z - middle[j // 16, i // 16], 16.0, per_post, per_height)
                )
                clear = z - near[j // 4, i // 4]
                step = max(step, free_range(clear, 4.0, per_post, per_height))
                if clear <= 0.0:
                    i, j = min(i, nx - 2), min(j, ny - 2)
                    z00 = elevation[j, i]
                    along_x, along_y = elevation[j, i + 1] - z00, elevation[j + 1, i] - z00
                    twist = elevation[j + 1, i + 1] - z00 - along_x - along_y
                    fx, fy = x - i, y - j
                    # Range to the edge of the cell.
                    cross = INFINITY if vx == 0.0 else ((1.0 - fx) if vx > 0.0 else -fx) / vx
                    if vy != 0.0:
                        cross = min(cross, ((1.0 - fy) if vy > 0.0 else -fy) / vy)
                    cross = max(cross, 0.0)
                    # Height above the surface after another range s: f0 + f1 s + f2 s^2.
                    f0 = z - (z00 + along_x * fx + along_y * fy + twist * fx * fy)
                    f1 = vz - (along_x * vx + along_y * vy + twist * (fx * vy + fy * vx))
                    if entering and f0 <= 0.0:
                        break  # enters through the side of the DEM, below its surface
                    hit = range_in_cell(f0, f1, -twist * vx * vy, cross)
                    if t + hit <= end:
                        ranges[k] = t + hit
                        break
                    step = max(step, cross)
                entering = False
                if t >= end:
                    break
                t = min(t + (step + NUDGE * min(per_post, 1.0)), end)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def free_range(clear: float, window: float, per_post: float, per_height: float) -> cython.double:
    """Range without a hit for a ray that is ``clear`` above the highest post of its window."""
    if clear <= 0.0:
        return 0.0
    # One post less than the window because the surface at its edge depends on the next post.
    return min((window - 1.0) * per_post, clear * per_height)


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def range_in_cell(f0: float, f1: float, f2: float, cross: float) -> cython.double:
    """First root of f0 + f1 s + f2 s^2 up to ``cross``, infinite if none; 0 if f0 is below 0."""
    if f0 <= 0.0:
        return 0.0
    square = f1 * f1 - 4.0 * f2 * f0
    if square < 0.0:
        return INFINITY
    below = sqrt(square) - f1
    # The tolerance covers the gap that `NUDGE` leaves between cells.
    if below <= 0.0 or 2.0 * f0 / below > cross * (1.0 + 1e-6):
        return INFINITY
    return 2.0 * f0 / below
