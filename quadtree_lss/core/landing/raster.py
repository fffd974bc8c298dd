# SPDX-License-Identifier: Apache-2.0
"""The map laid out on its finest cells: what hazard detection and scoring read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from quadtree_lss.core.geometry.feature import height, mean_height
from quadtree_lss.core.landing.distances import grown
from quadtree_lss.core.tree.quadtree import CellMap, Domain

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Lower tails of a feature are no feature, m.
NEGLIGIBLE = 0.005


@dataclass(frozen=True)
class TerrainRaster:
    """(n, n) arrays [iy, ix] over the finest cells.

    Attributes:
        domain: Extent and levels.
        leaf: Row of the leaf over each cell.
        elevation: Height at the cell's centre: the leaf's plane, or where the leaf was not
            measured (rock shadows, gaps) the nearest measured cell's; NaN if nothing is mapped, m.
        slope_x, slope_y: dz/dx, dz/dy of the leaf's plane; 0 where bridged.
        subscale: Mean height of the leaf's subscale feature over the cell (Eq. 57), m.
        subscale_peak: Its greatest height within the cell, m; 0 where that is negligible.
        seen: True where the ground lies within the set gap of a measurement.
        firm: True where a point fell or the gap is bridged from all around. Seen ground that is
            not borders on unseen ground: it may be the drop that casts the shadow.
    """

    domain: Domain
    leaf: NDArray[np.int32]
    elevation: Array
    slope_x: Array
    slope_y: Array
    subscale: Array
    subscale_peak: Array
    seen: Mask
    firm: Mask


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
    # About the middle of the domain, for the sake of digits.
    along = (np.arange(n) + 0.5 - 0.5 * n) * side
    x = cells.x - (domain.xmin + 0.5 * domain.size)
    y = cells.y - (domain.ymin + 0.5 * domain.size)
    measured = cells.measured[leaf]
    if not (cells.measured.any() and cells.observed.any()):
        nothing = np.zeros((n, n))
        unseen = np.zeros((n, n), dtype=np.bool_)
        flat = (nothing,) * 4
        return TerrainRaster(domain, leaf, nothing + np.nan, *flat, seen=unseen, firm=unseen)
    seen = grown(cells.observed, max_gap, side, short=0.5)
    firm = cells.observed | ~grown(~seen, max_gap, side, short=0.5)
    with np.errstate(invalid="ignore"):
        leaf_slope_x = np.where(cells.measured, -cells.normal[:, 0] / cells.normal[:, 2], 0.0)
        leaf_slope_y = np.where(cells.measured, -cells.normal[:, 1] / cells.normal[:, 2], 0.0)
    slope_x, slope_y = leaf_slope_x.take(leaf), leaf_slope_y.take(leaf)
    elevation = (cells.z - leaf_slope_x * x - leaf_slope_y * y).take(leaf)
    elevation += slope_x * along
    elevation += slope_y * along[:, None]
    if not measured.all():
        nearest = distance_transform_edt(~measured, return_distances=False, return_indices=True)
        elevation = elevation[nearest[0], nearest[1]]
    subscale, peak = np.zeros((n, n)), np.zeros((n, n))
    featured = np.isfinite(cells.feature[:, 1])
    if featured.any():
        where = np.nonzero(featured[leaf])
        rows = leaf[where]
        state, half = cells.feature[rows], 0.5 * side
        dx, dy = along[where[1]] - x[rows], along[where[0]] - y[rows]
        subscale[where] = mean_height(state, dx, dy, half)
        nearest_x = np.clip(state[:, 2], dx - half, dx + half)
        nearest_y = np.clip(state[:, 3], dy - half, dy + half)
        raised = height(state, nearest_x, nearest_y)
        peak[where] = np.where(raised >= NEGLIGIBLE, raised, 0.0)
    return TerrainRaster(domain, leaf, elevation, slope_x, slope_y, subscale, peak, seen, firm)
