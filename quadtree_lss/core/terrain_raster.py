# SPDX-License-Identifier: Apache-2.0
"""The map laid out on its finest cells: what hazard detection and scoring read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from quadtree_lss.core.bump import height
from quadtree_lss.core.quadtree import CellMap, Domain

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class TerrainRaster:
    """(n, n) arrays [iy, ix] over the finest cells.

    Attributes:
        domain: Extent and levels.
        leaf: Row of the leaf over each cell.
        elevation: Height at the cell's centre: the leaf's plane, or where the leaf was not
            measured (rock shadows, gaps) the nearest measured cell's; NaN if nothing is mapped, m.
        slope_x, slope_y: dz/dx, dz/dy of the leaf's plane; 0 where bridged.
        subscale: Greatest height of a subscale feature at the cell's centre (Eq. 57), m.
        seen: True where the ground lies within the set gap of a measurement.
    """

    domain: Domain
    leaf: NDArray[np.int32]
    elevation: Array
    slope_x: Array
    slope_y: Array
    subscale: Array
    seen: Mask


def rasterise(cells: CellMap, max_gap: float) -> TerrainRaster:
    """Lay out the map.

    Args:
        cells: The map.
        max_gap: Ground farther than this from any finest cell in which a point fell (distance of
            the centres less half a cell) is unseen, m.
    """
    domain = cells.domain
    n, side = domain.finest_count, domain.finest_size
    leaf = cells.leaf_raster()
    centre_x = domain.xmin + (np.arange(n) + 0.5) * side
    centre_y = domain.ymin + (np.arange(n) + 0.5) * side
    with np.errstate(invalid="ignore"):
        slope_x = (-cells.normal[:, 0] / cells.normal[:, 2])[leaf]
        slope_y = (-cells.normal[:, 1] / cells.normal[:, 2])[leaf]
    dx = centre_x - cells.x[leaf]
    dy = centre_y[:, None] - cells.y[leaf]
    elevation = cells.z[leaf] + slope_x * dx + slope_y * dy
    measured = cells.measured[leaf]
    seen = np.zeros((n, n), dtype=np.bool_)
    if measured.any() and cells.observed.any():
        gap = distance_transform_edt(~cells.observed) - 0.5
        seen = gap * side <= max_gap
        if not measured.all():
            nearest = distance_transform_edt(~measured, return_distances=False, return_indices=True)
            bridged = elevation[nearest[0], nearest[1]]
            elevation = np.where(measured, elevation, bridged)
            slope_x = np.where(measured, slope_x, 0.0)
            slope_y = np.where(measured, slope_y, 0.0)
    else:
        elevation = np.full((n, n), np.nan)
        slope_x = slope_y = np.zeros((n, n))
    subscale = np.zeros((n, n))
    featured = np.isfinite(cells.feature[:, 1])
    if featured.any():
        where = np.nonzero(featured[leaf])
        rows = leaf[where]
        subscale[where] = height(cells.feature[rows], dx[where], dy[where])
    return TerrainRaster(domain, leaf, elevation, slope_x, slope_y, subscale, seen)
