# SPDX-License-Identifier: Apache-2.0
"""First hit of rays on a bilinear heightfield, all rays of a scan at once.

A ray marches. Where it is above the highest post of the window around it, it may travel to that
height or to the edge of the window without hitting anything (windows of 64, 16 and 4 posts). Close
to the ground it moves from cell to cell; within a cell the height above the bilinear surface is a
quadratic of the range, whose first root is the hit. Hence hits are exact and no corner is missed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_WINDOWS = (64, 16, 4)
_NUDGE = 1e-7  # posts: past the edge of a cell, so that the next position is in the next cell


@dataclass(frozen=True)
class WindowMaxima:
    """For each window size (posts): highest post within one window of each block of that size."""

    windows: tuple[int, ...]
    maxima: tuple[FloatArray, ...]
    lowest: float
    highest: float

    @classmethod
    def of(cls, elevation: FloatArray) -> WindowMaxima:
        """Build from posts (ny, nx)."""
        maxima = []
        for window in _WINDOWS:
            rows, columns = (-(-n // window) for n in elevation.shape)
            blocks = np.full((rows + 2, columns + 2), -np.inf)
            edges_y, edges_x = np.arange(rows) * window, np.arange(columns) * window
            by_row = np.maximum.reduceat(elevation, edges_y, axis=0)
            blocks[1:-1, 1:-1] = np.maximum.reduceat(by_row, edges_x, axis=1)
            along_x = np.maximum(np.maximum(blocks[:, :-2], blocks[:, 1:-1]), blocks[:, 2:])
            maxima.append(np.maximum(np.maximum(along_x[:-2], along_x[1:-1]), along_x[2:]))
        return cls(_WINDOWS, tuple(maxima), float(elevation.min()), float(elevation.max()))


def cast_heightfield(
    x: FloatArray,
    y: FloatArray,
    elevation: FloatArray,
    maxima: WindowMaxima,
    origin_map: FloatArray,
    directions_map: FloatArray,
) -> FloatArray:
    """Range (N,) from ``origin_map`` (3,) along ``directions_map`` (N, 3); NaN = no hit."""
    ny, nx = elevation.shape
    dx, dy = (x[-1] - x[0]) / (nx - 1), (y[-1] - y[0]) / (ny - 1)
    origin = np.asarray(origin_map, float)
    directions = np.asarray(directions_map, float)
    # From here on horizontal coordinates count posts; the ray parameter stays a length.
    start = np.array([(origin[0] - x[0]) / dx, (origin[1] - y[0]) / dy, origin[2]])
    speed = directions / np.array([dx, dy, 1.0])

    low = np.array([0.0, 0.0, maxima.lowest - 1e-6])
    high = np.array([nx - 1.0, ny - 1.0, maxima.highest + 1e-6])
    enter, leave = _slab(start, speed, low, high)
    ranges = np.full(len(directions), np.nan)
    rays = np.flatnonzero(leave > enter)
    if not rays.size:
        return ranges
    _march(elevation, maxima, start, speed, enter, leave, rays, ranges)
    return ranges


def _slab(
    start: FloatArray, speed: FloatArray, low: FloatArray, high: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Ray parameters between which each ray is inside the box [low, high]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (low - start) / speed
        second = (high - start) / speed
    near, far = np.fmin(first, second), np.fmax(first, second)
    parallel = speed == 0.0
    inside = (start >= low) & (start <= high)
    near = np.where(parallel, np.where(inside, -np.inf, np.inf), near)
    far = np.where(parallel, np.where(inside, np.inf, -np.inf), far)
    return np.maximum(near.max(axis=1), 0.0), far.min(axis=1)


def _march(
    elevation: FloatArray,
    maxima: WindowMaxima,
    start: FloatArray,
    speed: FloatArray,
    enter: FloatArray,
    leave: FloatArray,
    rays: NDArray[np.int64],
    ranges: FloatArray,
) -> None:
    """Fill ``ranges`` of those ``rays`` that hit something."""
    v = speed[rays]
    t, end = enter[rays].copy(), leave[rays]
    with np.errstate(divide="ignore"):
        per_post = 1.0 / np.maximum(np.abs(v[:, 0]), np.abs(v[:, 1]))
        per_height = np.where(v[:, 2] < 0.0, -1.0 / v[:, 2], np.inf)
    first = True
    while rays.size:
        u = start[0] + t * v[:, 0]
        w = start[1] + t * v[:, 1]
        z = start[2] + t * v[:, 2]
        i, j = u.astype(np.int64), w.astype(np.int64)
        step = np.zeros(rays.size)
        clear = step
        for window, highest in zip(maxima.windows, maxima.maxima, strict=True):
            columns = highest.shape[1]
            block = np.minimum(j // window, highest.shape[0] - 1) * columns
            block += np.minimum(i // window, columns - 1)
            clear = z - highest.ravel()[block]
            # One post less than the window: the surface at its far edge hangs on the post beyond.
            free = np.minimum((window - 1) * per_post, np.maximum(clear, 0.0) * per_height)
            np.maximum(step, np.where(clear > 0.0, free, 0.0), out=step)
        near = np.flatnonzero(clear <= 0.0)
        ahead, cross = _cell(elevation, i[near], j[near], u[near], w[near], z[near], v[near])
        if first:
            # A ray that enters through the side of the DEM below its surface hits nothing known.
            ahead = np.where(ahead > 0.0, ahead, np.inf)
            first = False
        found = np.isfinite(ahead) & (t[near] + ahead <= end[near])
        ranges[rays[near[found]]] = t[near[found]] + ahead[found]
        step[near] = np.maximum(step[near], cross)
        step += _NUDGE * np.minimum(per_post, 1.0)
        going = t < end
        going[near[found]] = False
        keep = np.flatnonzero(going)
        t = np.minimum(t[keep] + step[keep], end[keep])
        rays, v, end = rays[keep], v[keep], end[keep]
        per_post, per_height = per_post[keep], per_height[keep]


def _cell(
    elevation: FloatArray,
    i: NDArray[np.int64],
    j: NDArray[np.int64],
    u: FloatArray,
    w: FloatArray,
    z: FloatArray,
    v: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Range ahead to the hit within the cell (i, j), inf if none, and to where the ray leaves it.

    Positions u, w count posts; a ray already below the surface has hit it (0 ahead).
    """
    ny, nx = elevation.shape
    i, j = np.minimum(i, nx - 2), np.minimum(j, ny - 2)
    corner = j * nx + i
    flat = elevation.ravel()
    z00 = flat[corner]
    along_u, along_w = flat[corner + 1] - z00, flat[corner + nx] - z00
    twist = flat[corner + nx + 1] - z00 - along_u - along_w
    fu, fw = u - i, w - j
    vu, vw = v[:, 0], v[:, 1]
    # Height above the surface at s ahead: f0 + f1 s + f2 s².
    f0 = z - (z00 + along_u * fu + along_w * fw + twist * fu * fw)
    f1 = v[:, 2] - (along_u * vu + along_w * vw + twist * (fu * vw + fw * vu))
    f2 = -twist * vu * vw
    with np.errstate(divide="ignore", invalid="ignore"):
        cross_u = np.where(vu > 0.0, 1.0 - fu, -fu) / vu
        cross_w = np.where(vw > 0.0, 1.0 - fw, -fw) / vw
        cross = np.maximum(
            np.minimum(np.where(vu == 0.0, np.inf, cross_u), np.where(vw == 0.0, np.inf, cross_w)),
            0.0,
        )
        square = f1 * f1 - 4.0 * f2 * f0
        below = np.sqrt(np.maximum(square, 0.0)) - f1
        ahead = 2.0 * f0 / below
        # The tolerance closes the gap that the nudge from cell to cell leaves open.
        hit = (square >= 0.0) & (below > 0.0) & (ahead <= cross * (1.0 + 1e-6))
    ahead = np.where(hit, ahead, np.inf)
    return np.where(f0 <= 0.0, 0.0, ahead), cross
