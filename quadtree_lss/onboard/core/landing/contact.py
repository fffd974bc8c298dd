# SPDX-License-Identifier: Apache-2.0
"""Step 2 of an assessment: contact of the vehicle with the ground at each grid point.

The vehicle has four pads on a circle and any of several headings. On uneven ground only three rigid
pads touch: the two of the higher diagonal, and either of the other two. So each heading has two
contact planes, with a common height z at the grid point and slopes x and y:

    tilt = max over all planes of sqrt(x^2 + y^2)
    rise = max over all planes and all cells under the vehicle of h - z - x u - y v

where h is the highest ground of a finest cell whose centre lies at (u, v) from the grid point.

The minimum of the contact planes is a concave function of (u, v). So it lies above the pyramid
through its values at the grid point and at four corners east, west, north and south of it, at a
distance of the greatest |u| + |v| under the vehicle. A comparison with this pyramid excludes most
columns of cells by their highest ground, and most cells of the other columns.
"""

# mypy: disable-error-code="attr-defined"
# (C arrays of `ContactKernel` are declared in the .pxd.)
from __future__ import annotations

from math import radians, tan
from typing import NamedTuple

import cython
import numpy as np
from cython.cimports.cpython.exc import PyErr_CheckSignals
from cython.cimports.libc.math import fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.landing.contact import HEADINGS, SPAN

from quadtree_lss.onboard.arrays import Array, Bytes, Mask, Single
from quadtree_lss.onboard.config.limits import YAWS
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.lattice import corner_bits, dilate, disc
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.tree.cell_map import SHAPE
from quadtree_lss.onboard.core.tree.domain import Domain, carried

#: Above any ground, m.
FAR_ABOVE = cython.declare(cython.double, 1e9)


class ContactLimits(NamedTuple):
    """A rise below ``min_rise``, m, is reported as this; so is the rise at a tilt above
    ``max_tilt``, rise over run, without being computed."""

    min_rise: float
    max_tilt: float


def touchdown_limits(config: LssConfig) -> ContactLimits:
    """Return the greatest rise and tilt of a safe touchdown."""
    lengths = config.vehicle.lengths
    return ContactLimits(lengths.touchdown_roughness, tan(radians(lengths.touchdown_slope_deg)))


class Contacts(NamedTuple):
    """Contact at each grid point, maximum over all headings: (n + 1, n + 1), NaN where not needed.

    ``rise``: greatest height of ground under the vehicle above a contact plane, m. ``tilt``: slope
    of the steepest contact plane, rise over run.
    """

    rise: Single
    tilt: Single


class ContactCheck:
    """Computes contacts on successive maps, only near changed cells."""

    def __init__(self, config: LssConfig, limits: ContactLimits) -> None:
        self.config, self.limits = config, limits
        self._computed_for: tuple[Domain, float | None] | None = None

    def contacts(
        self, raster: TerrainRaster, needed: Mask, heading: float | None = None
    ) -> Contacts:
        """Compute contacts at ``needed`` grid points (n + 1, n + 1).

        Their circle of pads lies inside the domain. ``heading``: rad; None for all `YAWS`.
        """
        if not needed.any():  # The vehicle may be larger than the domain.
            return Contacts(*np.full((2, *needed.shape), np.nan, dtype=np.float32))
        domain, radius = raster.domain, 0.5 * self.config.vehicle.diameter
        self._follow(domain, heading)
        changed = np.zeros(raster.elevation.shape, dtype=np.uint8)
        self._kernel.set_ground(raster, self._ground, changed)
        # Pads and cell centres under the vehicle are at most a radius away, so a corner of their
        # cell is, too.
        near = dilate(corner_bits(changed) > 0, radius, domain.finest_size)
        np.copyto(self._contacts, np.float32(np.nan), where=near)
        due = needed & np.isnan(self._contacts[0])
        self._kernel.update(due.view(np.uint8), self._contacts)
        return Contacts(*np.where(needed, self._contacts, np.float32(np.nan)))

    def _follow(self, domain: Domain, heading: float | None) -> None:
        """Move the ground and the contacts to ``domain``, or discard those of another heading."""
        n, moved = domain.finest_count, None
        if self._computed_for is not None and self._computed_for[1] == heading:
            moved = self._computed_for[0].cells_to(domain)
        if moved is None:
            self._kernel = ContactKernel(self.config, self.limits, domain.finest_size, heading)
            self._ground = np.full((4, n + 2 + -(-SPAN // (n + 2)), n + 2), np.nan)
            self._contacts = np.full((2, n + 1, n + 1), np.nan, dtype=np.float32)
        elif moved != (0, 0):
            inside = self._ground[:, 1 : n + 1, 1 : n + 1]
            inside[:] = carried(inside, *moved, np.nan)
            # Contacts at the border use border cells in place of those outside: recompute them.
            inside[:, [0, -1]] = inside[:, :, [0, -1]] = np.nan
            self._contacts = carried(self._contacts, *moved, np.nan)
        self._computed_for = domain, heading


@cython.boundscheck(False)
class ContactKernel:
    """Computes the contact of a vehicle at each grid point.

    Attributes:
        reach, half: As of `lattice.Disc`, of the finest cells under the vehicle.
        offset, share: (2 reach,) centres of its rows or columns from the grid point, m, and the
            same without a sign, over ``corner``.
        corner: Distance of the pyramid's corners from the grid point, m.
        pad_row, pad_column, pad_cell: (4 headings,) cell under each pad, from the one north-east of
            the grid point; the last in columns of ``ground``.
        pad_x, pad_y: (4 headings,) the pad from the centre of that cell, m.
        cos, sin: (headings,) of the headings, over the radius of the circle of pads, 1/m.
        ground: (4, rows x width) of each finest cell: contact height of a pad at its centre, m,
            slopes in x and y, and highest ground, m; with a copy of the border cells around it.
        highest: (reach + 1, width) highest ground of 0 to reach cells on either side of a row, m.
        z_low, z_east, z_west, z_north, z_south: Pyramids of a span of grid points, the corners over
            the middle, m.
        excess, max_excess: Upper bounds of the rise of each column of cells there, and of all, m.
        bound_y: Part of the pyramid of one grid point that depends on the row, m.
        highest_row, highest_column: Cell in the disc with the greatest rise at the last grid point.
    """

    def __init__(
        self, config: LssConfig, limits: ContactLimits, side: float, heading: float | None
    ) -> None:
        radius = 0.5 * config.vehicle.diameter
        under = disc(radius, side)
        self.min_rise, self.max_tilt = limits.min_rise, limits.max_tilt
        self.pad_radius, self.half_side = config.vehicle.pad_radius, 0.5 * side
        self.reach, self.half = under.reach, under.half
        assert HEADINGS == YAWS
        yaw = np.arange(YAWS) * (0.5 * np.pi / YAWS) if heading is None else np.full(YAWS, heading)
        c, s = np.cos(yaw), np.sin(yaw)
        self.cos, self.sin = c / radius, s / radius
        x, y = radius * np.concatenate([c, -s, -c, s]), radius * np.concatenate([s, c, -s, -c])
        column, row = np.floor(x / side).astype(np.intp), np.floor(y / side).astype(np.intp)
        self.pad_column, self.pad_row = column, row
        self.pad_x, self.pad_y = x - (column + 0.5) * side, y - (row + 0.5) * side
        offset = (np.arange(-under.reach, under.reach) + 0.5) * side
        self.corner = float((np.abs(under.x) + np.abs(under.y)).max())
        self.offset, self.share = offset, np.abs(offset) / self.corner
        self.excess = np.empty(2 * under.reach * SPAN)
        self.bound_y = np.empty(2 * under.reach)
        self.highest_row = self.highest_column = 0

    @cython.locals(changed=cython.uchar[:, ::1])
    def set_ground(self, raster: TerrainRaster, ground: Array, changed: Bytes) -> None:
        """Replace the ``ground`` (4, rows, n + 2) by that of a map, and mark ``changed`` cells."""
        cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
        elevation = cython.declare(cython.double[:, ::1], raster.elevation)
        slope_x = cython.declare(cython.double[:, ::1], raster.slope_x)
        slope_y = cython.declare(cython.double[:, ::1], raster.slope_y)
        subscale = cython.declare(cython.double[:, ::1], raster.subscale)
        n: cython.Py_ssize_t = changed.shape[0]
        self.width, self.ground = n + 2, ground.reshape(4, -1)
        cells = cython.declare(cython.double[:, :, ::1], ground)
        values = cython.declare(cython.double[4])
        half, pad_radius = self.half_side, self.pad_radius
        shape: cython.double = SHAPE
        with cython.nogil:
            for i in range(n):
                for j in range(n):
                    z, x, y = elevation[i, j], slope_x[i, j], slope_y[i, j]
                    pad = z + pad_radius * sqrt(x * x + y * y)
                    top = z + half * (fabs(x) + fabs(y)) + shape * subscale[i, j]
                    values[0], values[1], values[2], values[3] = pad, x, y, top
                    for k in range(4):
                        changed[i, j] |= values[k] != cells[k, i + 1, j + 1]
                        cells[k, i + 1, j + 1] = values[k]
        ground[:, :, 0], ground[:, :, n + 1] = ground[:, :, 1], ground[:, :, n]
        ground[:, 0], ground[:, n + 1 :] = ground[:, 1], ground[:, n, None]

    @cython.locals(due=cython.uchar[:, ::1], contacts=cython.float[:, :, ::1])
    def update(self, due: Bytes, contacts: Single) -> None:
        """Compute ``contacts`` (2, n + 1, n + 1), rise and tilt, at ``due`` grid points."""
        cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, p=cython.Py_ssize_t)
        cython.declare(k=cython.Py_ssize_t, cell=cython.Py_ssize_t)
        cython.declare(south=cython.Py_ssize_t, north=cython.Py_ssize_t)
        # The last span of a row can extend beyond it.
        self.highest = np.full((self.reach + 1, self.width + SPAN), -FAR_ABOVE)
        self.pad_cell = np.asarray(self.pad_row) * self.width + np.asarray(self.pad_column)
        for i in np.flatnonzero(np.asarray(due).any(axis=1)):
            with cython.nogil:
                for k in range(self.reach):
                    south, north = (i - k) * self.width, (i + k + 1) * self.width
                    for j in range(self.width):
                        z = max(self.ground[3, south + j], self.ground[3, north + j])
                        self.highest[k + 1, j] = max(self.highest[k, j], z)
                j = 0
                while j < due.shape[1]:
                    if not due[i, j]:
                        j += 1
                        continue
                    cell = (i + 1) * self.width + j + 1
                    self.find_planes(cell)
                    self.bound_rises(j + 1)
                    for p in range(min(SPAN, due.shape[1] - j)):
                        if due[i, j + p]:
                            contacts[0, i, j + p] = self.min_rise
                            contacts[1, i, j + p] = sqrt(self.steep[p])
                            if contacts[1, i, j + p] <= self.max_tilt:
                                contacts[0, i, j + p] = self.find_rise(cell + p, p)
                    j += SPAN
            PyErr_CheckSignals()  # The user can interrupt a large map.

    def find_planes(self, cell: cython.Py_ssize_t) -> None:
        """Find the contact planes and the pyramids below them at the grid points of a span;
        ``cell``: north-east of the first one, column of ``ground``."""
        cython.declare(i=cython.Py_ssize_t, k=cython.Py_ssize_t, p=cython.Py_ssize_t)
        cython.declare(x=cython.double, y=cython.double, u=cython.double, v=cython.double)
        corner: cython.double = self.corner
        for k in range(4 * HEADINGS):
            i, u, v = cell + self.pad_cell[k], self.pad_x[k], self.pad_y[k]
            for p in range(SPAN):
                x, y = self.ground[1, i + p] * u, self.ground[2, i + p] * v
                self.pad_z[k * SPAN + p] = self.ground[0, i + p] + x + y
        for p in range(SPAN):
            self.steep[p], self.z_low[p] = 0.0, FAR_ABOVE
            self.z_east[p] = self.z_west[p] = self.z_north[p] = self.z_south[p] = FAR_ABOVE
        for k in range(HEADINGS):
            cos, sin, i = self.cos[k], self.sin[k], k * SPAN
            for p in range(SPAN):
                east, north = self.pad_z[i + p], self.pad_z[HEADINGS * SPAN + i + p]
                west = self.pad_z[2 * HEADINGS * SPAN + i + p]
                south = self.pad_z[3 * HEADINGS * SPAN + i + p]
                z = 0.5 * max(east + west, north + south)
                # On the higher diagonal both differences are equal.
                x, y = (east - z) * cos - (north - z) * sin, (east - z) * sin + (north - z) * cos
                u, v = (z - west) * cos - (z - south) * sin, (z - west) * sin + (z - south) * cos
                self.plane_x[2 * i + p], self.plane_x[2 * i + SPAN + p] = x, u
                self.plane_y[2 * i + p], self.plane_y[2 * i + SPAN + p] = y, v
                self.plane_z[i + p] = z
                self.z_low[p] = min(self.z_low[p], z)
                self.z_east[p] = min(self.z_east[p], z + corner * min(x, u))
                self.z_west[p] = min(self.z_west[p], z - corner * max(x, u))
                self.z_north[p] = min(self.z_north[p], z + corner * min(y, v))
                self.z_south[p] = min(self.z_south[p], z - corner * max(y, v))
                self.steep[p] = max(self.steep[p], max(x * x + y * y, u * u + v * v))

    def bound_rises(self, column: cython.Py_ssize_t) -> None:
        """Bound the rise of each column of cells under the vehicle at the grid points of a span;
        ``column``: of the cell north-east of the first one, in ``highest``."""
        cython.declare(j=cython.Py_ssize_t, p=cython.Py_ssize_t, first=cython.Py_ssize_t)
        cython.declare(half=cython.Py_ssize_t)
        for p in range(SPAN):
            self.max_excess[p] = -FAR_ABOVE
            self.z_east[p] -= self.z_low[p]
            self.z_west[p] -= self.z_low[p]
            self.z_north[p] -= self.z_low[p]
            self.z_south[p] -= self.z_low[p]
        for j in range(2 * self.reach):
            half, first = self.half[j], column + j - self.reach
            share, aside = self.share[j], self.share[self.reach + half - 1]
            for p in range(SPAN):
                z = share * (self.z_west[p] if j < self.reach else self.z_east[p])
                z += aside * min(min(self.z_north[p], self.z_south[p]), 0.0)
                z = self.highest[half, first + p] - self.z_low[p] - z
                self.excess[j * SPAN + p] = z
                self.max_excess[p] = max(self.max_excess[p], z)

    def find_rise(self, cell: cython.Py_ssize_t, p: cython.Py_ssize_t) -> cython.double:
        """Return the greatest rise above the contact planes at grid point ``p`` of the span, m, at
        least ``min_rise``; ``cell``: as in `find_planes`."""
        cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
        cython.declare(first=cython.Py_ssize_t)
        rise = self.min_rise
        if self.max_excess[p] <= rise:
            return rise
        for k in range(2 * HEADINGS):
            self.contact_x[k] = self.plane_x[k * SPAN + p]
            self.contact_y[k] = self.plane_y[k * SPAN + p]
            self.contact_z[k] = self.plane_z[k // 2 * SPAN + p]
        for i in range(2 * self.reach):
            z = self.z_south[p] if i < self.reach else self.z_north[p]
            self.bound_y[i] = self.z_low[p] + self.share[i] * z
        first = cell - self.reach * self.width - self.reach
        # The cell with the greatest rise is often the same at the next grid point to the east.
        i, j = self.highest_row, max(self.highest_column - 1, 0)
        if self.reach - self.half[j] <= i < self.reach + self.half[j]:
            rise = max(rise, self.cell_rise(first + i * self.width + j, i, j))
            self.highest_column = j
        for j in range(2 * self.reach):
            if self.excess[j * SPAN + p] <= rise:
                continue
            bound_x = self.share[j] * (self.z_west[p] if j < self.reach else self.z_east[p])
            for i in range(self.reach - self.half[j], self.reach + self.half[j]):
                k = first + i * self.width + j
                if self.ground[3, k] - bound_x - self.bound_y[i] > rise:
                    z = self.cell_rise(k, i, j)
                    if z > rise:
                        rise, self.highest_row, self.highest_column = z, i, j
        return rise

    def cell_rise(
        self, cell: cython.Py_ssize_t, i: cython.Py_ssize_t, j: cython.Py_ssize_t
    ) -> cython.double:
        """Return the rise of the cell in row i and column j of the disc above the planes, m."""
        k: cython.Py_ssize_t
        above = cython.declare(cython.double[24])  # 2 HEADINGS
        z, u, v = self.ground[3, cell], self.offset[j], self.offset[i]
        for k in range(2 * HEADINGS):
            above[k] = z - self.contact_z[k] - self.contact_x[k] * u - self.contact_y[k] * v
        # Compare halves, so that the compiler vectorises the loop.
        for k in range(HEADINGS):
            above[k] = max(above[k], above[k + HEADINGS])
        for k in range(HEADINGS // 2):
            above[k] = max(above[k], above[k + HEADINGS // 2])
        return max(max(max(above[0], above[1]), max(above[2], above[3])), max(above[4], above[5]))
