# SPDX-License-Identifier: Apache-2.0
"""First hit of rays on a bilinear heightfield, all rays of a scan at once.

A ray marches. Where it is above the highest post of the window around it, it may travel to that
height or to the edge of the window without hitting anything (windows of 64, 16 and 4 posts); close
to the ground it moves half a post at a time. The bracket of the first crossing is then narrowed by
false position. What can be missed is a corner that the ray enters and leaves within half a post.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_WINDOWS = (64, 16, 4)
_REFINEMENTS = 6


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
    flat = elevation.ravel()
    bracket_low, bracket_high = _march(flat, nx, ny, maxima, start, speed, enter, leave, rays)
    hit = np.flatnonzero(np.isfinite(bracket_high))
    if hit.size:
        ranges[hit] = _refine(flat, nx, ny, start, speed[hit], bracket_low[hit], bracket_high[hit])
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


def _height(
    flat: FloatArray, nx: int, ny: int, start: FloatArray, speed: FloatArray, t: FloatArray
) -> FloatArray:
    """Height of each ray above the surface at its parameter t."""
    u = start[0] + t * speed[:, 0]
    v = start[1] + t * speed[:, 1]
    i = np.clip(u.astype(np.int64), 0, nx - 2)
    j = np.clip(v.astype(np.int64), 0, ny - 2)
    fu, fv = u - i, v - j
    corner = j * nx + i
    z00, z01 = flat[corner], flat[corner + 1]
    z10, z11 = flat[corner + nx], flat[corner + nx + 1]
    low = z00 + (z01 - z00) * fu
    surface = low + (z10 + (z11 - z10) * fu - low) * fv
    return np.asarray(start[2] + t * speed[:, 2] - surface)


def _march(
    flat: FloatArray,
    nx: int,
    ny: int,
    maxima: WindowMaxima,
    start: FloatArray,
    speed: FloatArray,
    enter: FloatArray,
    leave: FloatArray,
    rays: NDArray[np.int64],
) -> tuple[FloatArray, FloatArray]:
    """Bracket (above, below) of the first crossing of every ray; NaN where there is none."""
    above = np.full(len(speed), np.nan)
    below = np.full(len(speed), np.nan)
    v = speed[rays]
    t, end = enter[rays].copy(), leave[rays]
    last = t.copy()
    with np.errstate(divide="ignore"):
        per_post = 1.0 / np.maximum(np.abs(v[:, 0]), np.abs(v[:, 1]))
        per_height = np.where(v[:, 2] < 0.0, -1.0 / v[:, 2], np.inf)
    while rays.size:
        step = 0.5 * per_post
        i = (start[0] + t * v[:, 0]).astype(np.int64)
        j = (start[1] + t * v[:, 1]).astype(np.int64)
        z = start[2] + t * v[:, 2]
        clear = np.zeros(rays.size)
        for window, highest in zip(maxima.windows, maxima.maxima, strict=True):
            columns = highest.shape[1]
            j_block = np.clip(j // window, 0, highest.shape[0] - 1)
            i_block = np.clip(i // window, 0, columns - 1)
            clear = z - highest.ravel()[j_block * columns + i_block]
            free = np.minimum(window * per_post, np.maximum(clear, 0.0) * per_height)
            free[clear <= 0.0] = 0.0
            np.maximum(step, free, out=step)
        near = np.flatnonzero(clear <= 0.0)
        under = np.zeros(rays.size, bool)
        under[near] = _height(flat, nx, ny, start, v[near], t[near]) <= 0.0
        found = rays[under]
        above[found], below[found] = last[under], t[under]
        keep = np.flatnonzero(~under & (t < end))
        last = t[keep]
        t = np.minimum(last + step[keep], end[keep])
        rays, v, end = rays[keep], v[keep], end[keep]
        per_post, per_height = per_post[keep], per_height[keep]
    return above, below


def _refine(
    flat: FloatArray,
    nx: int,
    ny: int,
    start: FloatArray,
    speed: FloatArray,
    above: FloatArray,
    below: FloatArray,
) -> FloatArray:
    """False position (Illinois variant) within each bracket."""
    lo, hi = above.copy(), below.copy()
    f_lo = np.maximum(_height(flat, nx, ny, start, speed, lo), 0.0)
    f_hi = np.minimum(_height(flat, nx, ny, start, speed, hi), 0.0)
    side = np.zeros(lo.size, np.int8)
    t = hi
    for _ in range(_REFINEMENTS):
        gap = f_lo - f_hi
        t = np.where(gap > 0.0, lo + (hi - lo) * f_lo / np.where(gap > 0.0, gap, 1.0), hi)
        f = _height(flat, nx, ny, start, speed, t)
        over = f > 0.0
        f_hi = np.where(over & (side == 1), 0.5 * f_hi, f_hi)
        f_lo = np.where(~over & (side == -1), 0.5 * f_lo, f_lo)
        lo, f_lo = np.where(over, t, lo), np.where(over, f, f_lo)
        hi, f_hi = np.where(over, hi, t), np.where(over, f_hi, f)
        side = np.where(over, 1, -1).astype(np.int8)
    return t
