# SPDX-License-Identifier: Apache-2.0
"""Step 1 of an assessment: the terrain on the finest cells of the map."""

from __future__ import annotations

from dataclasses import dataclass

import cython
import numpy as np
from cython.cimports.libc.math import erf, exp, fabs, sqrt

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Mask
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.hazards import UNMAPPED, UNSEEN
from quadtree_lss.onboard.core.landing.lattice import (
    GroundPlanes,
    corner_bits,
    dilate,
    distance_from,
    ground_planes,
    nearest_marked,
    with_neighbours,
)
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain

TWO_PI = cython.declare(cython.double, 2.0 * np.pi)
#: Mean number of independent returns per known finest cell of a leaf up to which a cell can lack
#: returns by chance (e^-6 is 1 in 400); above, it is in the shadow of a rock or a drop.
MAX_RETURNS_IN_GAP = 6.0
#: Parts of a finest cell in `CellMap.coverage`.
COVERAGE_PARTS = 16.0
#: Greatest distance to a hazard that improves a score, m for the default vehicle (in proportion for
#: others); larger distances are not computed.
DISTANCE_CAP = 10.0
#: Relative rounding error of a length.
RELATIVE_ROUNDING = 1e-9


@dataclass(frozen=True)
class TerrainRaster:
    """The terrain on the finest cells, (n, n), and at their corners, (n + 1, n + 1).

    Attributes:
        leaf: (n, n) row of the leaf over each cell.
        elevation: (n, n) height at the cell's centre, m: of the leaf's plane within its bounds, or,
            where ``bridged``, of the nearest known cell; NaN if there is none.
        slope_x, slope_y: (n, n) dz/dx, dz/dy of the leaf's plane; 0 where ``bridged``.
        subscale: (n, n) mean height of the leaf's subscale feature over the cell (Eq. 57), m.
        subscale_peak: (n, n) greatest height of it within the cell, m; 0 where negligible.
        observed: (n, n) known, or in a gap within ``lss.gap`` of a known cell that is neither
            ``unestimated`` nor in a shadow.
        interior: (n, n) known, or in a gap that known cells enclose. Other observed ground borders
            on unobserved ground, which may be the drop that casts the shadow.
        unestimated: (n, n) observed, but not estimated.
        bridged: (n, n) the height is that of the nearest known cell.
        returns: (M,) mean `independent_returns` of each leaf per known finest cell.
        planes: The ground at the vehicle's scale at each grid point.
        free_distance: Distance of each grid point to ground that is not interior, outside the
            domain, or unestimated, m, up to a limit. Pads must not reach over unestimated ground,
            so it counts as nearer by their radius.
        to_unestimated: Distance of each grid point to unestimated ground, m, up to a limit.
        assessable: Grid points at which all ground under the vehicle is observed and estimated.
        needs_contact: Those and their neighbours, on which the predicted risk also depends, where
            the vehicle fits into the domain.
    """

    domain: Domain
    cells: CellMap
    leaf: Index
    elevation: Array
    slope_x: Array
    slope_y: Array
    subscale: Array
    subscale_peak: Array
    observed: Mask
    interior: Mask
    unestimated: Mask
    bridged: Mask
    returns: Array
    planes: GroundPlanes
    free_distance: Array
    to_unestimated: Array
    assessable: Mask
    needs_contact: Mask

    @property
    def unknown_bits(self) -> Bytes:
        """Return the hazard bits (n, n) of unobserved and unestimated finest cells."""
        bits = ~self.observed * np.uint8(UNSEEN)
        bits |= self.unestimated * np.uint8(UNMAPPED)
        return np.asarray(bits)


def rasterise(cells: CellMap, lss: LssConfig) -> TerrainRaster:
    """Transfer a map to its finest cells and evaluate the ground about each grid point."""
    domain = cells.domain
    n, side = domain.finest_count, domain.finest_size
    leaf = np.empty((n, n), dtype=np.intp)
    elevation, slope_x, slope_y, subscale, peak = layers = np.empty((5, n, n))
    layers[3:] = 0.0
    fill_layers(cells, side, lss.vehicle.lengths.negligible, leaf, layers)
    known = cells.observed & cells.known & ~np.isnan(elevation)
    bridged, unestimated = ~known, cells.observed & ~known
    gap = lss.gap + 0.5 * side  # from a cell's centre
    observed = dilate(known, gap, side) & ~unestimated
    share = np.bincount(leaf.ravel(), known.ravel(), len(cells.level))
    returns = np.minimum(cells.count / np.maximum(share, 1), independent_returns(cells.coverage))
    if not known.any():
        elevation[:] = np.nan
    elif bridged.any():
        # Fill gaps with level ground at the height of the nearest known cell.
        gap_cells, flat = np.flatnonzero(bridged), layers.reshape(5, -1)
        nearest = nearest_marked(known.view(np.uint8)).ravel()[gap_cells]
        flat[0, gap_cells] = flat[0, nearest]
        flat[1:3, gap_cells] = 0.0
        in_shadow = returns[leaf.ravel()[nearest]] > MAX_RETURNS_IN_GAP
        observed.ravel()[gap_cells[in_shadow]] = False
    interior = known | ~dilate(~observed, gap, side)
    radius = min(lss.vehicle.ground_radius, 0.5 * domain.size)
    # Distance of rows and columns of grid points to the domain's border, m.
    border = np.minimum(np.arange(n + 1), np.arange(n, -1, -1)) * side
    limit = max(lss.zone, DISTANCE_CAP * lss.vehicle.diameter_ratio)
    free_distance = distance_from(corner_bits((~interior).view(np.uint8)) > 0, side, limit)
    farthest = max(lss.zone, 0.5 * lss.vehicle.diameter) + lss.vehicle.pad_radius + side
    to_unestimated = distance_from(corner_bits(unestimated.view(np.uint8)) > 0, side, farthest)
    np.minimum(free_distance, to_unestimated - lss.vehicle.pad_radius, out=free_distance)
    np.minimum(free_distance, border, out=free_distance)
    np.minimum(free_distance, border[:, None], out=free_distance)
    needed = (0.5 - RELATIVE_ROUNDING) * lss.vehicle.diameter
    assessable, inside = free_distance >= needed, border >= needed
    planes = ground_planes(elevation, observed, side, radius)
    needs_contact = with_neighbours(assessable) & inside & inside[:, None]
    return TerrainRaster(
        domain, cells, leaf, elevation, slope_x, slope_y, subscale, peak, observed, interior,
        unestimated, bridged, returns, planes, free_distance, to_unestimated, assessable,
        needs_contact,
    )  # fmt: skip


def independent_returns(coverage: Array) -> Array:
    """Estimate the number of independent returns from the covered share (M,) of a finest cell.

    Repeated returns at the same positions, as in a hover, cover no new parts. Infinite where all
    parts are covered.
    """
    with np.errstate(divide="ignore"):
        return np.asarray(-COVERAGE_PARTS * np.log1p(-np.minimum(coverage, 1.0)))


@cython.boundscheck(False)
@cython.locals(leaf=cython.Py_ssize_t[:, ::1], layers=cython.double[:, :, ::1])
def fill_layers(cells: CellMap, side: float, negligible: float, leaf: Index, layers: Array) -> None:
    """Set the row of the ``leaf`` (n, n) over each finest cell of a ``side``, m, and its ``layers``
    (5, n, n): elevation, slopes in x and y, and of a feature, where there is one, the mean and, if
    not ``negligible``, the greatest height."""
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
    # Column by column, the feature's share and the squared distance to it.
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


@cython.cfunc
@cython.nogil
@cython.exceptval(check=False)
def bell_share(x: cython.double, half: cython.double, sigma: cython.double) -> cython.double:
    """Integrate a normal density about 0 from x - half to x + half."""
    scale = 1.0 / (sqrt(2.0) * sigma)
    return 0.5 * (erf((x + half) * scale) - erf((x - half) * scale))
