# SPDX-License-Identifier: Apache-2.0
"""Nodes, the corners of finest cells, and what lies in a disc about each of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.signal import oaconvolve

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


def disc(radius: float, side: float) -> Disc:
    """Cells of side ``side`` (m) within ``radius`` (m) of a node, four at the least."""
    reach = max(int(np.ceil(radius / side)), 1)
    offset = np.arange(-reach, reach)
    row, column = (grid.ravel() for grid in np.meshgrid(offset, offset, indexing="ij"))
    x, y = (column + 0.5) * side, (row + 0.5) * side
    inside = np.hypot(x, y) <= max(radius, 0.75 * side)
    return Disc(reach, row[inside], column[inside], x[inside], y[inside])


def node_sums(values: Array, weights: Array, over: Disc) -> Array:
    """Sums over the disc of each node: (n, n) cells to (n + 1, n + 1) nodes.

    Args:
        values: (n, n), zero is assumed outside.
        weights: (K,) one for each cell of the disc.
    """
    n, reach = len(values), over.reach
    kernel = np.zeros((2 * reach, 2 * reach))
    kernel[reach - 1 - over.row, reach - 1 - over.column] = weights
    full = oaconvolve(values, kernel)
    return full[reach - 1 : reach + n, reach - 1 : reach + n]


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
    over = disc(radius, raster.domain.finest_size)
    level = float(np.nanmean(raster.elevation))
    border = over.reach
    z = np.pad(raster.elevation - level, border, mode="edge")
    inner = slice(border, -border)

    def sums(weights: Array) -> Array:
        return node_sums(z, weights, over)[inner, inner]

    return NodePlanes(
        level + sums(np.full(len(over.x), 1.0 / len(over.x))),
        sums(over.x / np.sum(over.x**2)),
        sums(over.y / np.sum(over.y**2)),
    )


def touching(cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Bits of the up to four cells that meet at each node: (n, n) to (n + 1, n + 1)."""
    padded = np.pad(cells, 1)
    out: NDArray[np.uint8] = padded[:-1, :-1] | padded[1:, :-1] | padded[:-1, 1:] | padded[1:, 1:]
    return out


def distance_to(cells: Mask, side: float) -> Array:
    """Distance in m of each node (n + 1, n + 1) to the edge of the nearest marked cell (n, n).

    The point of a lattice square that is nearest to a lattice node is a lattice node itself, so
    the distance to the nearest corner of a marked cell is exact. Infinite if none is marked.
    """
    corner = touching(cells.astype(np.uint8)) > 0
    if not corner.any():
        return np.full(corner.shape, np.inf)
    out: Array = distance_transform_edt(~corner) * side
    return out


def sum_of_corners(nodes: Array) -> Array:
    """Sum of the four nodes of each cell: (n + 1, n + 1) to (n, n)."""
    return nodes[:-1, :-1] + nodes[1:, :-1] + nodes[:-1, 1:] + nodes[1:, 1:]
