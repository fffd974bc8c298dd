# SPDX-License-Identifier: Apache-2.0
"""The map on its finest cells, the input of hazard detection and scoring."""

from __future__ import annotations

from dataclasses import dataclass

import cython
import numpy as np
from cython.cimports.libc.math import erf, exp, fabs, sqrt

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Ints, Mask
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.lattice import grown, nearest_marked
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain

TWO_PI = cython.declare(cython.double, 2.0 * np.pi)
#: Independent returns in each known finest cell of a leaf, in the mean, among which a cell without
#: any is no chance (e^-6 is one in 400): it lies in a shadow, of a rock or of a drop.
CHANCE = cython.declare(cython.double, 6.0)
#: Parts of a finest cell of which `CellMap.coverage` counts those with a return.
PARTS = 16.0


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
            it is ``unmapped``, nor in a gap between so many returns that it is a shadow.
        firm: True where the ground is known or the gap is bridged from all around. Seen ground that
            is not borders on unseen ground: it may be the drop that casts the shadow.
        unmapped: True where a point fell whose return is not part of the map yet: seen by the
            lidar, but nobody knows what is there.
        bridged: True where the height is the nearest known cell's.
        returns: (M,) independent returns of each leaf on one of its known finest cells, in the mean
            (see `independent_returns`).
        cells: The map.
    """

    domain: Domain
    leaf: Index
    elevation: Array
    slope_x: Array
    slope_y: Array
    subscale: Array
    subscale_peak: Array
    seen: Mask
    firm: Mask
    unmapped: Mask
    bridged: Mask
    returns: Array
    cells: CellMap


def rasterise(cells: CellMap, lss: LssConfig) -> TerrainRaster:
    """Lay out the map.

    Args:
        cells: The map.
        lss: Ground farther than its ``gap`` from any finest cell that is known (distance of the
            centres less half a cell) is unseen. So is what lies nearer where the leaf of the
            nearest known cell has more than `CHANCE` returns in each.
    """
    max_gap, negligible = lss.gap, lss.vehicle.lengths.negligible
    domain = cells.domain
    n, side = domain.finest_count, domain.finest_size
    leaf = np.empty((n, n), dtype=np.intp)
    elevation, slope_x, slope_y, subscale, peak = layers = np.empty((5, n, n))
    layers[3:] = 0.0
    lay_out(cells, side, negligible, leaf, layers)
    known = cells.observed & cells.known & ~np.isnan(elevation)
    bridged = ~known
    unmapped = cells.observed & ~known
    seen = grown(known, max_gap, side, short=0.5) & ~unmapped
    share = np.zeros(len(cells.level), dtype=np.int32)
    count_known(leaf, known.view(np.uint8), share)
    returns = np.minimum(cells.count / np.maximum(share, 1), independent_returns(cells.coverage))
    if not known.any():
        elevation[:] = np.nan
    elif bridged.any():
        bridge(nearest_marked(known), leaf, returns, layers, seen.view(np.uint8))
    firm = known | ~grown(~seen, max_gap, side, short=0.5)
    found = (elevation, slope_x, slope_y, subscale, peak, seen, firm, unmapped, bridged, returns)
    return TerrainRaster(domain, leaf, *found, cells)


def independent_returns(coverage: Array) -> Array:
    """Number of returns at random places of a finest cell that covers this share (M,) of its parts.

    Returns at the same place again, as in a hover, cover nothing new. Infinite where all is
    covered: then any number of returns may be independent.
    """
    with np.errstate(divide="ignore"):
        return np.asarray(-PARTS * np.log1p(-np.minimum(coverage, 1.0)))


@cython.boundscheck(False)
@cython.locals(leaf=cython.Py_ssize_t[:, ::1], layers=cython.double[:, :, ::1])
def lay_out(cells: CellMap, side: float, negligible: float, leaf: Index, layers: Array) -> None:
    """Fill the finest cells under leaves (M).

    Args:
        cells: The map.
        side: Of the finest cells, m.
        negligible: Lower tails of a feature are no feature, m.
        leaf: (n, n), set to the row of the leaf.
        layers: (5, n, n), set to elevation, slopes in x and y; where there is a feature, the last
            two to its mean and its greatest height.
    """
    cython.declare(k=cython.Py_ssize_t, i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    cython.declare(row=cython.Py_ssize_t, column=cython.Py_ssize_t, width=cython.Py_ssize_t)
    cython.declare(beyond=cython.bint)
    depth = cython.declare(cython.uchar[::1], cells.level)
    ix = cython.declare(cython.uint[::1], cells.ix)
    iy = cython.declare(cython.uint[::1], cells.iy)
    z = cython.declare(cython.double[::1], cells.z)
    normal = cython.declare(cython.double[:, ::1], cells.normal)
    lowest = cython.declare(cython.double[::1], cells.low)
    highest = cython.declare(cython.double[::1], cells.high)
    feature = cython.declare(cython.double[:, ::1], cells.feature)
    half = 0.5 * side
    # Of a feature, column by column: its share, and the square of the distance.
    shares = cython.declare(cython.double[::1], np.empty(leaf.shape[1]))
    squares = cython.declare(cython.double[::1], np.empty(leaf.shape[1]))
    with cython.nogil:
        for k in range(depth.shape[0]):
            width = leaf.shape[0] >> cython.cast(cython.int, depth[k])
            row, column = iy[k] * width, ix[k] * width
            level, low, high = z[k], lowest[k], highest[k]
            middle = 0.5 * (width - 1)
            slope_x, slope_y = 0.0, 0.0
            if level == level:
                slope_x, slope_y = -normal[k, 0] / normal[k, 2], -normal[k, 1] / normal[k, 2]
            rise = (fabs(slope_x) + fabs(slope_y)) * middle * side
            beyond = level - rise < low or level + rise > high
            for i in range(row, row + width):
                y = (i - row - middle) * side
                for j in range(column, column + width):
                    height = level + slope_x * ((j - column - middle) * side) + slope_y * y
                    if beyond:
                        height = low if height < low else height
                        height = high if height > high else height
                    leaf[i, j] = k
                    layers[0, i, j], layers[1, i, j], layers[2, i, j] = height, slope_x, slope_y
            if not feature[k, 1] == feature[k, 1]:
                continue
            # Eq. 57: a bell is a product of two normal densities times its volume k^2.
            sigma, volume = feature[k, 4], feature[k, 1] * feature[k, 1]
            top = volume / (TWO_PI * sigma * sigma)
            for j in range(width):
                x = (j - middle) * side - feature[k, 2]
                shares[j] = bell_share(x, half, sigma)
                x = max(max(x - half, -x - half), 0.0)
                squares[j] = x * x
            for i in range(width):
                y = (i - middle) * side - feature[k, 3]
                share = bell_share(y, half, sigma) * volume / (side * side)
                y = max(max(y - half, -y - half), 0.0)
                square = y * y
                for j in range(width):
                    layers[3, row + i, column + j] = share * shares[j]
                    raised = top * exp(-0.5 * (squares[j] + square) / (sigma * sigma))
                    if raised >= negligible:
                        layers[4, row + i, column + j] = raised


@cython.boundscheck(False)
@cython.locals(leaf=cython.Py_ssize_t[:, ::1])
@cython.locals(known=cython.uchar[:, ::1], count=cython.int[::1])
def count_known(leaf: Index, known: Bytes, count: Ints) -> None:
    """Add up the ``known`` finest cells (n, n) of each leaf (M,)."""
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    with cython.nogil:
        for i in range(leaf.shape[0]):
            for j in range(leaf.shape[1]):
                count[leaf[i, j]] += known[i, j]


@cython.boundscheck(False)
@cython.locals(place=cython.int[:, ::1], leaf=cython.Py_ssize_t[:, ::1])
@cython.locals(returns=cython.double[::1], layers=cython.double[:, :, ::1])
@cython.locals(seen=cython.uchar[:, ::1])
def bridge(place: Ints, leaf: Index, returns: Array, layers: Array, seen: Bytes) -> None:
    """Level ground as high as the known cell that is nearest, unseen where that is in a shadow.

    Args:
        place: (n, n) flat index of the nearest known cell.
        leaf, layers: Of `lay_out`; the heights are set.
        returns, seen: Of `TerrainRaster`; the latter is set.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    n: cython.Py_ssize_t = place.shape[0]
    height = cython.declare(cython.double[::1], np.asarray(layers[0]).ravel())
    over = cython.declare(cython.Py_ssize_t[::1], np.asarray(leaf).ravel())
    with cython.nogil:
        for i in range(n):
            for j in range(n):
                if place[i, j] != i * n + j:
                    height[i * n + j] = height[place[i, j]]
                    layers[1, i, j], layers[2, i, j] = 0.0, 0.0
                    if returns[over[place[i, j]]] > CHANCE:
                        seen[i, j] = 0


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def bell_share(x: cython.double, half: cython.double, sigma: cython.double) -> cython.double:
    """Of a normal density about 0 between x - half and x + half."""
    scale = 1.0 / (sqrt(2.0) * sigma)
    return 0.5 * (erf((x + half) * scale) - erf((x - half) * scale))
