# SPDX-License-Identifier: Apache-2.0
"""Nodes, the corners of finest cells, and what lies in a disc about each of them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.distances import distance_from
from quadtree_lss.core.terrain_raster import TerrainRaster

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Disc:
    """Finest cells whose centre lies within a radius of a node (a corner of finest cells).

    Attributes:
        reach: Cells from the node to the disc's edge.
        row, column: (K,) index offset of each cell from the node's (the cell to its north-east).
        x, y: (K,) offset of each cell's centre from the node, m.
    """

    reach: int
    row: NDArray[np.intp]
    column: NDArray[np.intp]
    x: Array
    y: Array

    @cached_property
    def runs(self) -> list[tuple[int, list[int]]]:
        """Half widths 1, 2, ... ``reach`` in cells, and the rows of the disc that are so wide.

        The row ``row`` covers the columns -half to half - 1.
        """
        width = {
            row: int(self.column[self.row == row].max()) + 1
            for row in range(-self.reach, self.reach)
            if (self.row == row).any()
        }
        return [
            (half, [row for row, found in width.items() if found == half])
            for half in range(1, self.reach + 1)
        ]


def disc(radius: float, side: float) -> Disc:
    """Cells of side ``side`` (m) within ``radius`` (m) of a node, four at the least."""
    reach = max(int(np.ceil(radius / side)), 1)
    offset = np.arange(-reach, reach)
    row, column = (grid.ravel() for grid in np.meshgrid(offset, offset, indexing="ij"))
    x, y = (column + 0.5) * side, (row + 0.5) * side
    inside = np.hypot(x, y) <= max(radius, 0.75 * side)
    return Disc(reach, row[inside], column[inside], x[inside], y[inside])


def node_means(values: Array, over: Disc) -> Array:
    """Means over the disc of each node: (n, n) cells, 0 outside, to (n + 1, n + 1) nodes."""
    n = len(values)
    padded = np.pad(values, over.reach)
    run = np.zeros((len(padded), n + 1))
    out = np.zeros((n + 1, n + 1))
    # A disc is a stack of centred runs of cells.
    for half, rows in over.runs:
        left, right = over.reach - half, over.reach + half - 1
        run += padded[:, left : left + n + 1]
        run += padded[:, right : right + n + 1]
        for row in rows:
            out += run[over.reach + row : over.reach + row + n + 1]
    out /= len(over.x)
    return out


@dataclass(frozen=True)
class NodePlanes:
    """Least-squares plane of the map over a disc about each node: arrays (n + 1, n + 1).

    Attributes:
        elevation: Height at the node, m.
        slope_x, slope_y: dz/dx, dz/dy.
    """

    elevation: Array
    slope_x: Array
    slope_y: Array


def node_planes(raster: TerrainRaster, radius: float) -> NodePlanes:
    """Planes at the lander's scale.

    A disc about a node is symmetric, so the normal equations are diagonal:
    slope_x = sum(x z) / sum(x^2), slope_y alike, height = mean(z). Outside the domain the ground
    at its edge goes on.
    """
    side, n = raster.domain.finest_size, raster.domain.finest_count
    over = disc(radius, side)
    reach, level = over.reach, float(np.nanmean(raster.elevation))
    z = np.pad(raster.elevation - level, reach, mode="edge")
    # Sums over centred runs of cells of z and of x z; then rows above and below the node in pairs.
    run, moment, work = np.zeros((3, len(z), n + 1))
    sums, along_x, along_y = np.zeros((3, n + 1, n + 1))
    for half, rows in over.runs:
        west = z[:, reach - half : reach - half + n + 1]
        east = z[:, reach + half - 1 : reach + half + n]
        run += west
        run += east
        np.subtract(east, west, out=work)
        work *= half - 0.5
        moment += work
        for row in rows:
            here = slice(reach + row, reach + row + n + 1)
            sums += run[here]
            along_x += moment[here]
            np.multiply(run[here], row + 0.5, out=work[: n + 1])
            along_y += work[: n + 1]
    sums /= len(over.x)
    sums += level
    scale = side / np.sum(over.x**2)
    along_x *= scale
    along_y *= scale
    return NodePlanes(sums, along_x, along_y)


def touching(cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Bits of the up to four cells that meet at each node: (n, n) to (n + 1, n + 1)."""
    padded = np.pad(cells, 1)
    out: NDArray[np.uint8] = padded[:-1, :-1] | padded[1:, :-1] | padded[:-1, 1:] | padded[1:, 1:]
    return out


def distance_to(cells: Mask, side: float, cap: float = np.inf) -> Array:
    """Distance in m of each node (n + 1, n + 1) to the edge of the nearest marked cell (n, n).

    The point of a lattice square that is nearest to a lattice node is a lattice node itself, so
    the distance to the nearest corner of a marked cell is exact. Infinite if none is marked;
    distances over ``cap`` (m) may be given as infinite.
    """
    return distance_from(touching(cells.view(np.uint8)) > 0, side, cap)


def sum_of_corners(nodes: Array) -> Array:
    """Sum of the four nodes of each cell: (n + 1, n + 1) to (n, n)."""
    return nodes[:-1, :-1] + nodes[1:, :-1] + nodes[:-1, 1:] + nodes[1:, 1:]
