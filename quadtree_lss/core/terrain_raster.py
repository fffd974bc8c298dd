# SPDX-License-Identifier: Apache-2.0
"""The map laid out on its finest cells: what hazard detection and scoring read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from quadtree_lss.core.bump import height
from quadtree_lss.core.distances import grown
from quadtree_lss.core.quadtree import CellMap, Domain

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
        subscale: Greatest height of the leaf's subscale feature within the cell (Eq. 57), m; 0
            where it is negligible.
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
        return TerrainRaster(
            domain, leaf, nothing + np.nan, nothing, nothing, nothing, unseen, unseen
        )
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
    subscale = np.zeros((n, n))
    featured = np.isfinite(cells.feature[:, 1])
    if featured.any():
        where = np.nonzero(featured[leaf])
        rows = leaf[where]
        centre_x, centre_y = cells.feature[rows, 2], cells.feature[rows, 3]
        dx = _beyond(along[where[1]] - x[rows] - centre_x, 0.5 * side)
        dy = _beyond(along[where[0]] - y[rows] - centre_y, 0.5 * side)
        raised = height(cells.feature[rows], centre_x + dx, centre_y + dy)
        subscale[where] = np.where(raised >= NEGLIGIBLE, raised, 0.0)
    return TerrainRaster(domain, leaf, elevation, slope_x, slope_y, subscale, seen, firm)


def _beyond(away: Array, half: float) -> Array:
    """Distance from a cell of half a side to what lies ``away`` (N,) from its centre, signed; 0
    within."""
    return np.sign(away) * np.maximum(np.abs(away) - half, 0.0)
