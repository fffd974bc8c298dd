# SPDX-License-Identifier: Apache-2.0
"""The lattice of grid points, the corners of finest cells, and the ground in a disc about each."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import isqrt, sqrt

import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Ints, Mask
from quadtree_lss.onboard.core.landing.sweeps import disc_moments, find_distances, find_nearest

FAR = 16
"""Beyond so many steps one distance transform takes less than a step at a time."""

NEAR = 126
"""Distances of so many steps fit ``sweeps.find_distances``."""


@dataclass(frozen=True)
class Disc:
    """Finest cells whose centre lies within a radius of a grid point.

    Attributes:
        reach: Cells from the grid point to the disc's edge.
        row, column: (K,) index offset of each cell from the grid point's (the cell to its
            north-east).
        x, y: (K,) offset of each cell's centre from the grid point, m.
        to_plane: (3, K) what the height of each cell weighs in the height, dz/dx and dz/dy of their
            least-squares plane (see ``ground_planes``).
        half: (2 reach,) half width of the disc in each row, from the southernmost, in cells.
    """

    reach: int
    row: Index
    column: Index
    x: Array
    y: Array
    to_plane: Array
    half: Index


@lru_cache(maxsize=16)
def disc(radius: float, side: float) -> Disc:
    """Cells of side ``side`` (m) within ``radius`` (m) of a grid point, four at the least."""
    reach = max(int(np.ceil(radius / side)), 1)
    offset = np.arange(-reach, reach)
    row, column = (grid.ravel() for grid in np.meshgrid(offset, offset, indexing="ij"))
    x, y = (column + 0.5) * side, (row + 0.5) * side
    inside = np.hypot(x, y) <= max(radius, 0.75 * side)
    half = np.count_nonzero(inside.reshape(2 * reach, 2 * reach), axis=1) // 2
    x, y = x[inside], y[inside]
    to_plane = np.stack([np.full(len(x), 1.0 / len(x)), x / np.sum(x**2), y / np.sum(y**2)])
    return Disc(reach, row[inside], column[inside], x, y, to_plane, half)


def disc_means(values: Array, over: Disc, seen: Mask) -> Array:
    """Means over the disc of each grid point at the ``seen`` ones of the cells (n, n)."""
    out, none = np.empty((len(values) + 1,) * 2), np.empty((0, 0))
    disc_moments(values, 0.0, over.half, seen.view(np.uint8), 1.0, out, *(none,) * 3)
    return out


@dataclass(frozen=True)
class GroundPlanes:
    """Least-squares plane of the map over a disc about each grid point: arrays (n + 1, n + 1).

    Attributes:
        elevation: Height at the grid point, m.
        slope_x, slope_y: dz/dx, dz/dy.
        slope: Angle to the horizontal, rad.
    """

    elevation: Array
    slope_x: Array
    slope_y: Array
    slope: Array


def ground_planes(elevation: Array, seen: Mask, side: float, radius: float) -> GroundPlanes:
    """Planes at the lander's scale, of the height (n, n) of finest cells of side ``side`` m.

    They are those of the ground at grid points at ``seen`` cells.

    A disc about a grid point is symmetric, so the normal equations are diagonal:
    slope_x = sum(x z) / sum(x^2), slope_y alike, height = mean(z). Outside the domain the ground
    at its edge goes on.
    """
    over = disc(radius, side)
    level = float(np.mean(elevation))
    square = side * float(np.mean((over.x / side) ** 2))
    height, along_x, along_y, steep = np.empty((4, len(elevation) + 1, len(elevation) + 1))
    found = height, along_x, along_y, steep
    disc_moments(elevation, level, over.half, seen.view(np.uint8), square, *found)
    return GroundPlanes(height, along_x, along_y, np.arctan(steep, out=steep))


def touching(cells: Bytes) -> Bytes:
    """Bits of the up to four cells that meet at each grid point: (n, n) to (n + 1, n + 1).

    The point of a lattice square that is nearest to a grid point is a grid point itself, so the
    distance to the nearest grid point that touches a marked cell is that to the cell's edge.
    """
    rows, columns = cells.shape
    out = np.zeros((rows + 1, columns + 1), dtype=np.uint8)
    for i, j in (0, 0), (0, 1), (1, 0), (1, 1):
        out[i : i + rows, j : j + columns] |= cells
    return out


def distance_from(marked: Mask, side: float, limit: float = np.inf) -> Array:
    """Distance in m of each point to the nearest marked one, infinite if none is marked.

    Args:
        marked: (ny, nx).
        side: Of the lattice, m.
        limit: What is farther than this may be told to be infinitely far, m.
    """
    if not marked.any():
        return np.full(marked.shape, np.inf)
    if limit >= NEAR * side:
        return np.asarray(np.sqrt(nearest_marked(marked)[0]) * side)
    far = int(limit / side) + 1
    lengths = np.sqrt(np.arange(far**2 + 1)) * side
    lengths[-1] = np.inf
    out = np.empty(marked.shape)
    find_distances(np.ascontiguousarray(marked).view(np.uint8), lengths, far, out)
    return out


def nearest_marked(marked: Mask) -> tuple[Ints, Ints]:
    """Square of the distance of each point to the nearest marked one, in steps, and its place.

    Args:
        marked: (ny, nx), somewhere True.

    Returns:
        (ny, nx) squares and (ny, nx) flat indices.
    """
    square, place = np.empty((2, *marked.shape), dtype=np.int32)
    find_nearest(np.ascontiguousarray(marked).view(np.uint8), square, place)
    return square, place


def grown(marked: Mask, distance: float, side: float, short: float = 0.0) -> Mask:
    """Points within ``distance`` (m) of a marked one, the marked ones included.

    Args:
        marked: (ny, nx).
        distance: m.
        side: Of the lattice, m.
        short: Steps by which distances are taken to be shorter.
    """
    if not marked.any():
        return marked.copy()
    longest = sum(marked.shape)
    square = int(min(distance / side + short, longest) ** 2) + 2
    while square > 0 and (sqrt(square) - short) * side > distance:
        square -= 1
    if square > FAR**2:
        return np.asarray(nearest_marked(marked)[0] <= square)
    out: Mask = marked.copy()
    run = marked.copy()
    reach, width = min(isqrt(square), len(marked) - 1), 0
    # A disc is a stack of centred runs: the farthest row has the shortest.
    for row in range(reach, -1, -1):
        while width < isqrt(square - row * row) and width < marked.shape[1] - 1:
            width += 1
            run[:, width:] |= marked[:, :-width]
            run[:, :-width] |= marked[:, width:]
        out[row:] |= run[: len(run) - row]
        out[: len(run) - row] |= run[row:]
    return out
