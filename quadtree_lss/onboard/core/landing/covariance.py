# SPDX-License-Identifier: Apache-2.0
"""How well the ground at a site is known: covariance of its height and tilt from the leaves'."""

from __future__ import annotations

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.geometry.heights import height_by_error
from quadtree_lss.onboard.core.landing.lattice import disc
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.tree.cell_map import CellMap

#: Any heading is as good as another: variance of an angle of which nothing is known, rad^2.
ANY_HEADING = np.pi**2 / 3.0


def ground_covariance(
    cells: CellMap, raster: TerrainRaster, x: float, y: float, radius: float
) -> Array:
    """Covariance (6, 6) of the ground's plane at the lander's scale, about a place of the map.

    Order and axes are those of ``PoseWithCovariance``: x, y, z in m, rotations about the map's
    fixed axes in rad. The place in x and y is one of the map, and has no error of its own: its rows
    are 0. Height and tilt are those of the least-squares plane over the leaves' planes in a disc
    (see ``lattice.ground_planes``). Range noise is another one in each leaf; the error of the poses
    is common to all of the map nearby, and enters as that of one plane. Slopes are taken for small.

    Args:
        cells, raster: The map.
        x, y: The place, map frame, m.
        radius: Of the disc, m.
    """
    domain = raster.domain
    side, last = domain.finest_size, domain.finest_count - 1
    over = disc(radius, side)
    at_x, at_y = (x - domain.xmin) / side, (y - domain.ymin) / side
    row = (round(at_y) + over.row).clip(0, last)
    column = (round(at_x) + over.column).clip(0, last)
    leaf, of_cell = np.unique(raster.leaf[row, column], return_inverse=True)
    known = cells.measured[leaf]
    if not known.any():
        return np.full((6, 6), np.nan)
    size = domain.cell_size(cells.level[leaf])
    middle_x = domain.xmin + (cells.ix[leaf] + 0.5) * size
    middle_y = domain.ymin + (cells.iy[leaf] + 0.5) * size
    normal = cells.normal[leaf]
    heights = height_by_error(
        normal[of_cell], x + over.x - middle_x[of_cell], y + over.y - middle_y[of_cell]
    )
    of_leaf = (of_cell == np.flatnonzero(known)[:, None])[:, None] * over.to_plane @ heights
    out = np.sum(of_leaf @ cells.covariance_range[leaf[known]] @ of_leaf.swapaxes(1, 2), axis=0)
    nearest = of_cell[np.argmin(np.where(known[of_cell], np.hypot(over.x, over.y), np.inf))]
    across = x + over.x - middle_x[nearest], y + over.y - middle_y[nearest]
    common = over.to_plane @ height_by_error(normal[nearest, None], *across)
    out += common @ cells.covariance_pose[leaf[nearest]] @ common.T
    # Ground that rises along y is turned about x, ground that rises along x about -y.
    turn = np.zeros((6, 3))
    turn[2, 0], turn[3, 2], turn[4, 1] = 1.0, 1.0, -1.0
    covariance = turn @ out @ turn.T
    covariance[5, 5] = ANY_HEADING
    return np.asarray(covariance)
