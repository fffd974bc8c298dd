# SPDX-License-Identifier: Apache-2.0
"""What leaves give out, against planar ground and against what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.tree.cell_map import CellMap


@dataclass(frozen=True)
class Claims:
    """Of M measured leaves.

    Attributes:
        height: (M,) error of the height at the middle of what was seen, over its deviation.
        slope: (M, 2) errors of the slope in the leaf's tangent, along the axes of its covariance,
            each over its deviation.
        error, claimed: (M, 2) of heights, m, and of the worse axis of the slope, rad.
        share: (M,) finest cells under the leaf in which a point fell, over all.
    """

    height: Array
    slope: Array
    error: Array
    claimed: Array
    share: Array

    @property
    def all(self) -> Array:
        """All ratios in one row."""
        return np.concatenate([self.height, self.slope.ravel()])


def claims(cells: CellMap, gradient: tuple[float, float] = (0.0, 0.0)) -> Claims:
    """Compare with the plane z = gradient . (x, y)."""
    finest, raster = cells.domain.finest_size, cells.leaf_raster()
    row, column = np.nonzero(cells.observed)
    x = cells.domain.xmin + (column + 0.5) * finest
    y = cells.domain.ymin + (row + 0.5) * finest
    leaf, count = raster[row, column], len(cells.z)
    seen = np.bincount(leaf, minlength=count)
    rows = np.flatnonzero(cells.measured & (seen > 0))
    x, y = (np.bincount(leaf, v, count)[rows] / seen[rows] for v in (x, y))
    ground = cells.at(x, y)
    off = ground.height - (gradient[0] * x + gradient[1] * y)
    true = np.array([-gradient[0], -gradient[1], 1.0])
    true /= np.linalg.norm(true)
    # Eq. 2: axes of the tangent at the leaf's normal.
    n = cells.normal[rows]
    share = n[:, :2, None] * n[:, None, :2] / (1.0 + n[:, 2])[:, None, None]
    axes = np.concatenate([np.eye(2) - share, -n[:, None, :2]], axis=1)
    # Eq. 4 and Eq. 9: the way from the leaf's normal to the true one.
    across = np.einsum("mij,i->mj", axes, true)
    sine = np.linalg.norm(across, axis=1)
    tilt = across * (np.arctan2(sine, n @ true) / np.maximum(sine, 1e-12))[:, None]
    values, vectors = np.linalg.eigh(cells.covariance[rows, :2, :2])
    along, deviation = np.einsum("mi,mij->mj", tilt, vectors), np.sqrt(np.maximum(values, 1e-18))
    ratio = along / deviation
    worse = np.arange(len(rows)), np.abs(ratio).argmax(axis=1)
    part = seen[rows] / 4.0 ** (cells.domain.max_level - cells.level[rows].astype(float))
    return Claims(
        off / ground.deviation,
        ratio,
        np.column_stack([off, along[worse]]),
        np.column_stack([ground.deviation, deviation[worse]]),
        part,
    )


def summary(ratios: Array) -> tuple[float, float, float]:
    """Root mean square, share beyond 4, and greatest."""
    size = np.abs(ratios)
    return float(np.sqrt(np.mean(size**2))), float(np.mean(size > 4.0)), float(size.max())


def within(points: Array, x: Array, y: Array, reach: float = 1.0) -> tuple[Array, Array]:
    """Lowest and highest of points (N, 3) within reach of each place (K,), NaN for none.

    To a tenth of a metre: of squares of this size whose middles are so near.
    """
    points, side = points[np.isfinite(points).all(axis=1)], 0.1
    margin = int(np.ceil(reach / side)) + 1
    start = np.minimum(points[:, :2].min(axis=0), [x.min(), y.min()]) - margin * side
    end = np.maximum(points[:, :2].max(axis=0), [x.max(), y.max()]) + margin * side
    shape = (np.ceil((end - start) / side).astype(int) + 1)[::-1]
    low, high = np.full(shape, np.inf), np.full(shape, -np.inf)
    column, row = ((points[:, :2] - start) / side).astype(int).T
    np.minimum.at(low, (row, column), points[:, 2])
    np.maximum.at(high, (row, column), points[:, 2])
    column, row = ((np.column_stack([x, y]) - start) / side).astype(int).T
    lowest, highest = np.full(len(x), np.inf), np.full(len(x), -np.inf)
    for i, j in np.argwhere(np.ones((2 * margin + 1,) * 2)) - margin:
        middle = start + side * (np.column_stack([column + j, row + i]) + 0.5)
        near = np.hypot(middle[:, 0] - x, middle[:, 1] - y) <= reach
        at = row[near] + i, column[near] + j
        lowest[near] = np.minimum(lowest[near], low[at])
        highest[near] = np.maximum(highest[near], high[at])
    none = lowest > highest
    return np.where(none, np.nan, lowest), np.where(none, np.nan, highest)
