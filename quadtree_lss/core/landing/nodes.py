# SPDX-License-Identifier: Apache-2.0
"""Nodes, the corners of finest cells, and what lies in a disc about each of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.landing.raster import TerrainRaster

Array = NDArray[np.float64]

#: Rows of nodes whose discs are summed at once.
STRIP = 96


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
    out = np.zeros((n + 1, n + 1))
    # A disc is a stack of centred runs of cells.
    for rows, strip in _strips(out, padded, over):
        run = np.zeros((len(strip), n + 1))
        for half, offsets in over.runs:
            run += strip[:, over.reach - half :][:, : n + 1]
            run += strip[:, over.reach + half - 1 :][:, : n + 1]
            for row in offsets:
                rows += run[over.reach + row :][: len(rows)]
    out /= len(over.x)
    return out


def _strips(nodes: Array, padded: Array, over: Disc) -> Iterator[tuple[Array, Array]]:
    """Rows of nodes, few enough for the cache, with the rows of padded cells in their discs."""
    for first in range(0, len(nodes), STRIP):
        rows = nodes[first : first + STRIP]
        yield rows, padded[first : first + len(rows) + 2 * over.reach - 1]


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
    out = NodePlanes(*np.zeros((3, n + 1, n + 1)))
    columns = zip(
        _strips(out.elevation, z, over),
        _strips(out.slope_x, z, over),
        _strips(out.slope_y, z, over),
        strict=True,
    )
    # Sums over centred runs of cells of z and of x z.
    for (height, strip), (slope_x, _), (slope_y, _) in columns:
        run, moment, work = np.zeros((3, len(strip), n + 1))
        for half, rows in over.runs:
            west = strip[:, reach - half :][:, : n + 1]
            east = strip[:, reach + half - 1 :][:, : n + 1]
            run += west
            run += east
            np.subtract(east, west, out=work)
            work *= half - 0.5
            moment += work
            for row in rows:
                here = slice(reach + row, reach + row + len(height))
                height += run[here]
                slope_x += moment[here]
                slope_y += np.multiply(run[here], row + 0.5, out=work[here])
    np.divide(out.elevation, len(over.x), out=out.elevation)
    np.add(out.elevation, level, out=out.elevation)
    for slope in (out.slope_x, out.slope_y):
        slope *= side / np.sum(over.x**2)
    return out


def touching(cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Bits of the up to four cells that meet at each node: (n, n) to (n + 1, n + 1).

    The point of a lattice square that is nearest to a lattice node is a lattice node itself, so
    the distance to the nearest node that touches a marked cell is that to the cell's edge.
    """
    padded = np.pad(cells, 1)
    out: NDArray[np.uint8] = padded[:-1, :-1] | padded[1:, :-1] | padded[:-1, 1:] | padded[1:, 1:]
    return out


def sum_of_corners(nodes: Array) -> Array:
    """Sum of the four nodes of each cell: (n + 1, n + 1) to (n, n)."""
    return nodes[:-1, :-1] + nodes[1:, :-1] + nodes[:-1, 1:] + nodes[1:, 1:]
