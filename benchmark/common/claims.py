# SPDX-License-Identifier: Apache-2.0
"""Errors of leaves over their claimed standard deviations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.tree.cell_map import CellMap


@dataclass(frozen=True)
class Claims:
    """Errors of M estimated leaves over their claimed standard deviations.

    Attributes:
        height: (M,) at the centre of the observed part, relative to the mean of the ground there.
        slope: (M, 2) in the tangent plane along the axes of the covariance, relative to the
            least-squares plane of the whole leaf.
    """

    height: Array
    slope: Array

    @property
    def all(self) -> Array:
        """All ratios."""
        return np.concatenate([self.height, self.slope.ravel()])


#: A surface: heights (N,) at x, y (N,), m.
Surface = Callable[[Array, Array], Array]
#: Coordinates of the samples for the true plane of a leaf, over its side.
LATTICE = (np.arange(16) + 0.5) / 16.0 - 0.5


def level(x: Array, y: Array) -> Array:
    """The surface z = 0."""
    return np.zeros(np.broadcast_shapes(x.shape, y.shape))


def claims(cells: CellMap, surface: Surface = level) -> Claims:
    """Compare leaves with the true surface."""
    finest, raster = cells.domain.finest_size, cells.leaf_raster()
    row, column = np.nonzero(cells.observed)
    x = cells.domain.xmin + (column + 0.5) * finest
    y = cells.domain.ymin + (row + 0.5) * finest
    leaf, count = raster[row, column], len(cells.z)
    observed = np.bincount(leaf, minlength=count)
    rows = np.flatnonzero(cells.measured & (observed > 0))
    means = (np.bincount(leaf, v, count)[rows] / observed[rows] for v in (x, y, surface(x, y)))
    x, y, z = means
    ground = cells.at(x, y)
    height_error = ground.height - z
    true = true_normals(cells, rows, surface)
    # Eq. 2: axes of the tangent at the leaf's normal.
    n = cells.normal[rows]
    projection = n[:, :2, None] * n[:, None, :2] / (1.0 + n[:, 2])[:, None, None]
    axes = np.concatenate([np.eye(2) - projection, -n[:, None, :2]], axis=1)
    # Eq. 4 and Eq. 9: rotation from the normal of the leaf to the true one.
    components = np.einsum("mij,mi->mj", axes, true)
    sine, cosine = np.linalg.norm(components, axis=1), np.einsum("mi,mi->m", n, true)
    tilt = components * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-12))[:, None]
    values, vectors = np.linalg.eigh(cells.covariance[rows, :2, :2])
    along, deviation = np.einsum("mi,mij->mj", tilt, vectors), np.sqrt(np.maximum(values, 1e-18))
    return Claims(height_error / ground.deviation, along / deviation)


def true_normals(cells: CellMap, rows: Array, surface: Surface) -> Array:
    """Normals (M, 3) of the least-squares planes of the ground under leaves."""
    x, y = (side.ravel() for side in np.meshgrid(LATTICE, LATTICE))
    size = cells.size[rows][:, None]
    z = surface(cells.x[rows][:, None] + size * x, cells.y[rows][:, None] + size * y)
    # On a regular lattice, slopes and height are independent.
    slopes = [z @ of / (size[:, 0] * np.sum(of**2)) for of in (x, y)]
    normal = np.column_stack([-slopes[0], -slopes[1], np.ones(len(rows))])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def summary(ratios: Array) -> tuple[float, float, float]:
    """Root mean square, share beyond 4, and maximum of the absolute values."""
    size = np.abs(ratios)
    return float(np.sqrt(np.mean(size**2))), float(np.mean(size > 4.0)), float(size.max())
