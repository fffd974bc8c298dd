# SPDX-License-Identifier: Apache-2.0
"""The map laid out on its finest cells: what hazard detection and scoring read."""

from __future__ import annotations

from dataclasses import dataclass

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Array, Index, Ints, Mask
from quadtree_lss.onboard.core.landing.lattice import grown, nearest_marked
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain

if not cython.compiled:
    from math import erf, exp, fabs, pi, sqrt

    from quadtree_lss.onboard.core.geometry.bounds import within

    M_PI = pi


#: Lower tails of a feature are no feature, m.
NEGLIGIBLE = cython.declare(cython.double, 0.005)


@dataclass(frozen=True)
class TerrainRaster:
    """(n, n) arrays [iy, ix] over the finest cells.

    Attributes:
        domain: Extent and levels.
        leaf: Row of the leaf over each cell.
        elevation: Height at the cell's centre: the leaf's plane within its bounds, or where the
            leaf was not measured (rock shadows, gaps) the nearest known cell's; NaN if none is, m.
        slope_x, slope_y: dz/dx, dz/dy of the leaf's plane; 0 where bridged.
        subscale: Mean height of the leaf's subscale feature over the cell (Eq. 57), m.
        subscale_peak: Its greatest height within the cell, m; 0 where that is negligible.
        seen: True where the ground is known or lies within the set gap of a known cell; never where
            it is ``unmapped``.
        firm: True where the ground is known or the gap is bridged from all around. Seen ground that
            is not borders on unseen ground: it may be the drop that casts the shadow.
        unmapped: True where a point fell whose return is not part of the map yet: seen by the
            lidar, but nobody knows what is there.
        bridged: True where the height is the nearest known cell's.
        cells: The map.
    """

    domain: Domain
    leaf: Ints
    elevation: Array
    slope_x: Array
    slope_y: Array
    subscale: Array
    subscale_peak: Array
    seen: Mask
    firm: Mask
    unmapped: Mask
    bridged: Mask
    cells: CellMap


def rasterise(cells: CellMap, max_gap: float) -> TerrainRaster:
    """Lay out the map.

    Args:
        cells: The map.
        max_gap: Ground farther than this from any finest cell that is known (distance of the
            centres less half a cell) is unseen, m.
    """
    domain = cells.domain
    n, side = domain.finest_count, domain.finest_size
    leaf = np.empty((n, n), dtype=np.int32)
    elevation, slope_x, slope_y, subscale, peak = layers = np.empty((5, n, n))
    layers[3:] = 0.0
    down = domain.max_level - cells.level.astype(np.intp)
    lay_out(
        cells.iy.astype(np.intp) << down,
        cells.ix.astype(np.intp) << down,
        np.left_shift(1, down),
        cells.z,
        cells.low,
        cells.high,
        cells.normal,
        cells.feature,
        side,
        leaf,
        layers,
    )
    known = cells.observed & cells.known & ~np.isnan(elevation)
    bridged = ~known
    unmapped = cells.observed & ~known
    seen = grown(known, max_gap, side, short=0.5) & ~unmapped
    firm = known | ~grown(~seen, max_gap, side, short=0.5)
    if not known.any():
        elevation[:] = np.nan
    elif bridged.any():
        elevation[bridged] = elevation.take(nearest_marked(known)[1][bridged])
        slope_x[bridged] = slope_y[bridged] = 0.0
    found = (elevation, slope_x, slope_y, subscale, peak, seen, firm, unmapped, bridged)
    return TerrainRaster(domain, leaf, *found, cells)


@cython.boundscheck(False)
def lay_out(
    row: Index,
    column: Index,
    width: Index,
    z: Array,
    low: Array,
    high: Array,
    normal: Array,
    feature: Array,
    side: float,
    leaf: Ints,
    layers: Array,
) -> None:
    """Fill the finest cells under leaves (M).

    Args:
        row, column: (M,) of each leaf's first finest cell.
        width: (M,) finest cells along its side.
        z: (M,) plane's elevation at the centre, NaN if there is none, m.
        low, high: (M,) what the plane's heights keep to, m; NaN for no bound.
        normal, feature: (M, 3), (M, 5).
        side: Of the finest cells, m.
        leaf: (n, n), set to the row of the leaf.
        layers: (5, n, n), set to elevation, slopes in x and y; where there is a feature, the last
            two to its mean and its greatest height.
    """
    cython.declare(k=cython.Py_ssize_t, i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    cython.declare(beyond=cython.bint)
    half = 0.5 * side
    # Of a feature, column by column: its share, and the square of the distance.
    shares = cython.declare(cython.double[::1], np.empty(leaf.shape[1]))
    squares = cython.declare(cython.double[::1], np.empty(leaf.shape[1]))
    with cython.nogil:
        for k in range(z.shape[0]):
            middle = 0.5 * (width[k] - 1)
            slope_x, slope_y = 0.0, 0.0
            if z[k] == z[k]:
                slope_x, slope_y = -normal[k, 0] / normal[k, 2], -normal[k, 1] / normal[k, 2]
            rise = (fabs(slope_x) + fabs(slope_y)) * middle * side
            beyond = z[k] - rise < low[k] or z[k] + rise > high[k]
            for i in range(row[k], row[k] + width[k]):
                y = (i - row[k] - middle) * side
                for j in range(column[k], column[k] + width[k]):
                    x = (j - column[k] - middle) * side
                    leaf[i, j] = k
                    layers[0, i, j] = z[k] + slope_x * x + slope_y * y
                    if beyond:
                        layers[0, i, j] = within(layers[0, i, j], low[k], high[k])
                    layers[1, i, j] = slope_x
                    layers[2, i, j] = slope_y
            if not feature[k, 1] == feature[k, 1]:
                continue
            # Eq. 57: a bell is a product of two normal densities times its volume k^2.
            sigma, volume = feature[k, 4], feature[k, 1] * feature[k, 1]
            top = volume / (2.0 * M_PI * sigma * sigma)
            for j in range(width[k]):
                x = (j - middle) * side - feature[k, 2]
                shares[j] = bell_share(x, half, sigma)
                squares[j] = max(max(x - half, -x - half), 0.0) ** 2
            for i in range(width[k]):
                y = (i - middle) * side - feature[k, 3]
                share = bell_share(y, half, sigma) * volume / (side * side)
                square = max(max(y - half, -y - half), 0.0) ** 2
                for j in range(width[k]):
                    layers[3, row[k] + i, column[k] + j] = share * shares[j]
                    raised = top * exp(-0.5 * (squares[j] + square) / (sigma * sigma))
                    if raised >= NEGLIGIBLE:
                        layers[4, row[k] + i, column[k] + j] = raised


def bell_share(x: float, half: float, sigma: float) -> float:
    """Of a normal density about 0 between x - half and x + half."""
    scale = 1.0 / (sqrt(2.0) * sigma)
    return 0.5 * (erf((x + half) * scale) - erf((x - half) * scale))
