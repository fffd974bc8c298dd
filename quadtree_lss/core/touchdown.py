# SPDX-License-Identifier: Apache-2.0
"""Touchdown check on the estimated map: the lander's four pads set down on the leaf planes.

At every node the lander stands on its pads at a number of headings. Four rigid pads on uneven
ground rock about the diagonal that carries: the plane through the higher diagonal and either of
the other two pads. Each such plane must be level enough, and no ground under the lander may rise
above it by more than the roughness limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import oaconvolve

from quadtree_lss.core.config import LssConfig
from quadtree_lss.core.terrain_raster import TerrainRaster

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: Nodes treated at once, so that the working set stays in the cache.
BLOCK_ROWS = 16
BLOCK_NODES = 2048


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
    slope_x = sum(x z) / sum(x^2), slope_y alike, height = mean(z).
    """
    over = disc(radius, raster.domain.finest_size)
    level = float(np.nanmean(raster.elevation))
    z = np.nan_to_num(raster.elevation - level)
    return NodePlanes(
        level + node_sums(z, np.full(len(over.x), 1.0 / len(over.x)), over),
        node_sums(z, over.x / np.sum(over.x**2), over),
        node_sums(z, over.y / np.sum(over.y**2), over),
    )


def unsafe_nodes(
    raster: TerrainRaster, planes: NodePlanes, candidates: Mask, config: LssConfig
) -> Mask:
    """Nodes (n + 1, n + 1) at which some heading fails; False where not a candidate.

    Args:
        raster: The map on its finest cells.
        planes: Lander-scale planes of the same raster, any radius; they only bound the search.
        candidates: (n + 1, n + 1) nodes to check; their lander circle lies inside the domain.
    """
    unsafe = np.zeros(candidates.shape, dtype=np.bool_)
    rows, columns = np.nonzero(candidates)
    if not len(rows):
        return unsafe
    over = disc(0.5 * config.vehicle_diameter, raster.domain.finest_size)
    stance = _Stance(raster, planes, config)
    top = _tops(raster, planes.elevation)
    worst = _greatest_residual(top, planes, over, candidates)
    for begin in range(0, len(rows), BLOCK_NODES):
        r, c = rows[begin : begin + BLOCK_NODES], columns[begin : begin + BLOCK_NODES]
        unsafe[r, c] = stance.fails(r, c, worst[r, c], top, over)
    return unsafe


def _tops(raster: TerrainRaster, reference: Array) -> Single:
    """Highest ground of each finest cell: plane, its rise to the cell's corner, subscale feature.

    Heights are over the mean of ``reference`` and padded with a border as wide as any disc needs.
    """
    half = 0.5 * raster.domain.finest_size
    rise = (np.abs(raster.slope_x) + np.abs(raster.slope_y)) * half
    top = raster.elevation + rise + raster.subscale - float(np.mean(reference))
    return top.astype(np.float32)


def _greatest_residual(
    top: Single, planes: NodePlanes, over: Disc, candidates: Mask
) -> Single:
    """Greatest height of the tops in each node's disc above the node's plane, (n + 1, n + 1)."""
    n = len(top)
    reach = over.reach
    padded = np.pad(top, reach, mode="edge")
    slope_x, slope_y = planes.slope_x.astype(np.float32), planes.slope_y.astype(np.float32)
    height = (planes.elevation - float(np.mean(planes.elevation))).astype(np.float32)
    out = np.full((n + 1, n + 1), -np.inf, dtype=np.float32)
    busy = np.flatnonzero(candidates.any(axis=1))
    first, last = int(busy[0]), int(busy[-1]) + 1
    columns = np.flatnonzero(candidates.any(axis=0))
    left, right = int(columns[0]), int(columns[-1]) + 1
    for begin in range(first, last, BLOCK_ROWS):
        end = min(begin + BLOCK_ROWS, last)
        gx, gy = slope_x[begin:end, left:right], slope_y[begin:end, left:right]
        best = out[begin:end, left:right]
        work = np.empty_like(best)
        tilt_y = np.empty_like(best)
        previous = None
        for row, column, x, y in zip(
            over.row.tolist(), over.column.tolist(), over.x.tolist(), over.y.tolist(), strict=True
        ):
            if row != previous:
                np.multiply(gy, np.float32(y), out=tilt_y)
                previous = row
            np.multiply(gx, np.float32(x), out=work)
            work += tilt_y
            window = padded[
                begin + row + reach : end + row + reach, left + column + reach : right + column + reach
            ]
            np.subtract(window, work, out=work)
            np.maximum(best, work, out=best)
        best -= height[begin:end, left:right]
    return out


class _Stance:
    """The lander on its pads, for blocks of nodes."""

    def __init__(self, raster: TerrainRaster, planes: NodePlanes, config: LssConfig) -> None:
        self.config = config
        self.radius = 0.5 * config.vehicle_diameter
        self.side = raster.domain.finest_size
        self.planes = planes
        self.level = float(np.mean(planes.elevation))
        tilt = np.hypot(raster.slope_x, raster.slope_y)
        self.pad = raster.elevation - self.level + config.pad_radius * tilt
        self.slope_x, self.slope_y = raster.slope_x, raster.slope_y

    def heights(self, rows: NDArray[np.intp], columns: NDArray[np.intp], x: float, y: float) -> Array:
        """Height (K,) that a pad at offset (x, y) from each node stands on, m."""
        n = len(self.pad)
        right, up = int(np.floor(x / self.side)), int(np.floor(y / self.side))
        at = np.clip(rows + up, 0, n - 1) * n + np.clip(columns + right, 0, n - 1)
        dx, dy = x - (right + 0.5) * self.side, y - (up + 0.5) * self.side
        return (
            self.pad.ravel()[at]
            + self.slope_x.ravel()[at] * dx
            + self.slope_y.ravel()[at] * dy
        )

    def fails(
        self,
        rows: NDArray[np.intp],
        columns: NDArray[np.intp],
        worst: Single,
        top: Single,
        over: Disc,
    ) -> Mask:
        """Which nodes (K,) fail at some heading.

        ``worst`` bounds the roughness above a resting plane from above: the greatest height over
        the node's plane, plus the greatest distance between the two planes on the circle. Only
        nodes that this bound does not clear are evaluated cell by cell.
        """
        config = self.config
        limit = np.tan(np.radians(config.touchdown_slope_deg)) ** 2
        plane_z = (self.planes.elevation - self.level)[rows, columns]
        gx, gy = self.planes.slope_x[rows, columns], self.planes.slope_y[rows, columns]
        failed = np.zeros(len(rows), dtype=np.bool_)
        doubts: list[tuple[NDArray[np.intp], Array]] = []
        for yaw in np.arange(config.touchdown_yaws) * (0.5 * np.pi / config.touchdown_yaws):
            c, s = np.cos(yaw), np.sin(yaw)
            pads = [
                self.heights(rows, columns, self.radius * px, self.radius * py)
                for px, py in ((c, s), (-s, c), (-c, -s), (s, -c))
            ]
            first, second = pads[0] + pads[2], pads[1] + pads[3]
            carried = first >= second
            centre = 0.5 * np.maximum(first, second)
            along = np.where(carried, pads[0] - pads[2], pads[1] - pads[3]) / (2.0 * self.radius)
            ahead = np.where(carried, pads[1], pads[0])
            behind = np.where(carried, pads[3], pads[2])
            ax, ay = np.where(carried, c, -s), np.where(carried, s, c)
            bx, by = np.where(carried, -s, c), np.where(carried, c, s)
            for across in ((ahead - centre) / self.radius, (centre - behind) / self.radius):
                failed |= along**2 + across**2 > limit
                tx, ty = along * ax + across * bx, along * ay + across * by
                apart = plane_z - centre + self.radius * np.hypot(gx - tx, gy - ty)
                doubt = np.flatnonzero(~failed & (worst + apart > config.touchdown_roughness))
                if len(doubt):
                    doubts.append((doubt, np.stack([centre, tx, ty])[:, doubt]))
        if doubts:
            self._look_closely(failed, rows, columns, doubts, top, over)
        return failed

    def _look_closely(
        self,
        failed: Mask,
        rows: NDArray[np.intp],
        columns: NDArray[np.intp],
        doubts: list[tuple[NDArray[np.intp], Array]],
        top: Single,
        over: Disc,
    ) -> None:
        """Evaluate doubtful (node, plane) pairs over every cell of the disc."""
        n = len(top)
        wanted = np.unique(np.concatenate([doubt for doubt, _ in doubts]))
        wanted = wanted[~failed[wanted]]
        if not len(wanted):
            return
        place = np.full(len(rows), -1, dtype=np.intp)
        place[wanted] = np.arange(len(wanted))
        at_row = np.clip(rows[wanted, None] + over.row, 0, n - 1)
        at_column = np.clip(columns[wanted, None] + over.column, 0, n - 1)
        ground = top[at_row, at_column]
        basis = np.stack([np.ones_like(over.x), over.x, over.y]).astype(np.float32)
        limit = np.float32(self.config.touchdown_roughness)
        for doubt, plane in doubts:
            open_ = ~failed[doubt]
            doubt, plane = doubt[open_], plane[:, open_]
            if not len(doubt):
                continue
            above = ground[place[doubt]] - plane.T.astype(np.float32) @ basis
            failed[doubt] = above.max(axis=1) > limit
