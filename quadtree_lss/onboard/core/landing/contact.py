# SPDX-License-Identifier: Apache-2.0
"""Contact of the vehicle with the ground at each grid point: its tilt, and what rises under it.

The vehicle stands on four pads on a circle, at a number of headings. Four rigid pads on uneven
ground touch it with three: the two pads of the higher diagonal carry the vehicle, and it rocks onto
either of the other two. So each heading has two resting planes, with a common height z at the grid
point and slopes x and y:

    tilt = max over all planes of sqrt(x^2 + y^2)
    rise = max over all planes and all cells under the vehicle of h - z - x u - y v

where h is the highest ground of a finest cell whose centre lies at (u, v) from the grid point.

The lowest of the resting planes is a concave function of (u, v). So it lies above the pyramid
through its values at the grid point and at four points east, west, north and south of it, at a
distance of the greatest |u| + |v| under the vehicle. A comparison with this pyramid excludes most
cells, four at a time.
"""

# mypy: disable-error-code="attr-defined"
# (C arrays of `ContactKernel` are declared in the .pxd.)
from __future__ import annotations

from dataclasses import dataclass
from math import radians, tan

import cython
import numpy as np
from cython.cimports.cpython.exc import PyErr_CheckSignals
from cython.cimports.libc.math import sqrt
from cython.cimports.quadtree_lss.onboard.core.landing.contact import SPAN

from quadtree_lss.onboard.arrays import Array, Bytes, Mask, Single
from quadtree_lss.onboard.config.limits import YAWS
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.lattice import disc, grown, touching
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.tree.cell_map import SHAPE
from quadtree_lss.onboard.core.tree.domain import Domain, carried

#: Higher than any ground, m.
FAR = cython.declare(cython.double, 1e9)


@dataclass(frozen=True)
class ContactLimits:
    """Contacts of which the exact values are needed.

    Attributes:
        least_rise: A smaller rise is reported as this, m.
        most_tilt: Where the vehicle is steeper, the rise is not computed and reported as
            ``least_rise``; rise over run.
    """

    least_rise: float
    most_tilt: float


@dataclass(frozen=True)
class Contacts:
    """Contact at each grid point, over all headings: (n + 1, n + 1), NaN where it was not needed.

    Attributes:
        rise: Greatest height of ground under the vehicle above a resting plane, m.
        tilt: Slope of the steepest resting plane, rise over run.
    """

    rise: Single
    tilt: Single


class ContactCheck:
    """Computes contacts on successive maps, and only near cells that changed.

    ``limits`` are by default the touchdown limits of ``config``.
    """

    def __init__(self, config: LssConfig, limits: ContactLimits | None = None) -> None:
        self.config = config
        self.most_tilt = tan(radians(config.vehicle.lengths.touchdown_slope_deg))
        self.most_rise = config.vehicle.lengths.touchdown_roughness
        self.limits = limits or ContactLimits(self.most_rise, self.most_tilt)
        self._computed_for: tuple[Domain, float | None] | None = None

    def contacts(
        self, raster: TerrainRaster, needed: Mask, heading: float | None = None
    ) -> Contacts:
        """Contacts at grid points.

        Args:
            raster: The map on its finest cells.
            needed: (n + 1, n + 1) grid points to evaluate. Their circle of pads lies inside the
                domain.
            heading: Heading of the vehicle, about z from x, rad; None for all `YAWS`.
        """
        if not needed.any():  # The vehicle may be larger than the domain.
            return Contacts(*np.full((2, *needed.shape), np.nan, dtype=np.float32))
        changed = self._update_ground(raster, heading)
        domain, radius = raster.domain, 0.5 * self.config.vehicle.diameter
        # A pad or cell centre under the vehicle is at most a radius away, so a corner of its cell
        # is, too.
        near = grown(touching(changed.view(np.uint8)) > 0, radius, domain.finest_size)
        self._contacts[:, near] = np.nan
        due = needed & np.isnan(self._contacts[0])
        self._kernel.update(self._ground, due.view(np.uint8), self._contacts)
        return Contacts(*np.where(needed, self._contacts, np.float32(np.nan)))

    def _update_ground(self, raster: TerrainRaster, heading: float | None) -> Mask:
        """Lay out the ground of a map, and return the cells (n, n) that changed."""
        domain, n = raster.domain, raster.domain.finest_count
        moved = None
        if self._computed_for is not None and self._computed_for[1] == heading:
            moved = self._computed_for[0].cells_to(domain)
        if moved is None:
            self._kernel = ContactKernel(self.config, self.limits, domain.finest_size, heading)
            self._ground = np.full((4, n, n), np.nan)
            self._contacts = np.full((2, n + 1, n + 1), np.nan, dtype=np.float32)
        elif moved != (0, 0):
            self._ground = carried(self._ground, *moved, np.nan)
            # Contacts at the border read its cells again in place of those outside.
            self._ground[:, [0, -1]] = self._ground[:, :, [0, -1]] = np.nan
            self._contacts = carried(self._contacts, *moved, np.nan)
        self._computed_for = domain, heading
        x, y, z = raster.slope_x, raster.slope_y, raster.elevation
        pad = z + self.config.vehicle.pad_radius * np.sqrt(x * x + y * y)
        top = z + 0.5 * domain.finest_size * (np.abs(x) + np.abs(y)) + SHAPE * raster.subscale
        ground = np.stack([pad, x, y, top])
        changed: Mask = (ground != self._ground).any(axis=0)
        self._ground = ground
        return changed

    def exceeds_limits(self, contacts: Contacts) -> Mask:
        """Where a contact exceeds the touchdown limits."""
        high = contacts.rise > np.float32(self.most_rise)
        return np.asarray(high | (contacts.tilt > np.float32(self.most_tilt)))


@cython.boundscheck(False)
class ContactKernel:
    """Contact of a vehicle at one grid point after the other.

    Attributes:
        reach: Rows and columns of the disc of finest cells under the vehicle, north or south and
            east or west of the grid point.
        half: (2 reach,) half width of the disc in each row, in cells.
        offset: (2 reach,) centres of these rows, or of columns, from the grid point, m.
        share: (2 reach,) the same without a sign, over ``corner``.
        pad_row, pad_column: (4 headings,) cell under each pad, from the one north-east of the grid
            point.
        pad_x, pad_y: (4 headings,) the pad from the centre of that cell, m.
        cos, sin: (headings,) of the headings, over the radius of the circle of pads, 1/m.
        corner: Distance of the pyramid's corners from the grid point, m.
        width: Cells in a row of ``ground``, which repeats the cells at the border once outside.
        ground: (4, width^2) of each finest cell: height that a pad at its centre rests on, m,
            slopes in x and y, and highest ground, m.
        top: Highest ground of each square of 2 x 2 cells, by its south-western cell, m.
        pad_cell: (4 headings,) cell under each pad, as columns of ``ground`` from the cell
            north-east of the grid point.
        pad_z, plane_x, plane_y, plane_z: (4 headings,), (2 headings,) pads and resting planes at
            the present grid point.
        z_low, z_east, z_west, z_north, z_south: Heights of the pyramid there, m.
        bound_x, bound_y: (2 reach,) parts of these that depend on the column and the row, m.
    """

    def __init__(
        self, config: LssConfig, limits: ContactLimits, side: float, heading: float | None
    ) -> None:
        radius = 0.5 * config.vehicle.diameter
        under = disc(radius, side)
        self.least_rise, self.most_tilt = limits.least_rise, limits.most_tilt
        self.reach, self.half = under.reach, under.half
        self.offset = (np.arange(-under.reach, under.reach) + 0.5) * side
        yaw = np.arange(YAWS) * (0.5 * np.pi / YAWS) if heading is None else np.array([heading])
        c, s = np.cos(yaw), np.sin(yaw)
        self.cos, self.sin = c / radius, s / radius
        x, y = radius * np.concatenate([c, -s, -c, s]), radius * np.concatenate([s, c, -s, -c])
        self.pad_column = np.floor(x / side).astype(np.intp)
        self.pad_row = np.floor(y / side).astype(np.intp)
        self.pad_x = x - (np.asarray(self.pad_column) + 0.5) * side
        self.pad_y = y - (np.asarray(self.pad_row) + 0.5) * side
        self.bound_x, self.bound_y = np.empty((2, 2 * under.reach))
        self.corner = float((np.abs(under.x) + np.abs(under.y)).max())
        self.share = np.abs(np.asarray(self.offset)) / self.corner
        assert len(x) <= 48, "see the .pxd"

    @cython.locals(due=cython.uchar[:, ::1], contacts=cython.float[:, :, ::1])
    def update(self, ground: Array, due: Bytes, contacts: Single) -> None:
        """Compute ``contacts`` (2, n + 1, n + 1), rise and tilt, at ``due`` grid points.

        ``ground`` (4, n, n): pad height, slopes in x and y, highest ground of the finest cells.
        """
        cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, p=cython.Py_ssize_t)
        cython.declare(k=cython.Py_ssize_t, cell=cython.Py_ssize_t)
        cython.declare(count=cython.Py_ssize_t, some=cython.uchar)
        n: cython.Py_ssize_t = ground.shape[1]
        self.width = n + 2
        # The last span of a row goes on in the next row.
        around = np.pad(ground, ((0, 0), (1, 2 + SPAN // (n + 2)), (1, 1)), mode="edge")
        self.ground = around.reshape(4, -1)
        pairs = np.maximum(self.ground[3, 1:], self.ground[3, :-1])
        self.top = np.maximum(pairs[n + 2 :], pairs[: -(n + 2)])
        self.pad_cell = np.asarray(self.pad_row) * (n + 2) + np.asarray(self.pad_column)
        first: cython.Py_ssize_t = self.reach - 1
        after: cython.Py_ssize_t = n + 1 - max(np.max(self.pad_row), self.reach - 1)
        for i in range(first, after):
            with cython.nogil:
                for k in range((after - first + SPAN - 1) // SPAN):
                    j = first + k * SPAN
                    count = min(SPAN, after - j)
                    some = 0
                    for p in range(count):
                        some |= due[i, j + p]
                    if not some:
                        continue
                    cell = (i + 1) * self.width + j + 1
                    self.find_planes(cell)
                    for p in range(count):
                        if due[i, j + p]:
                            contacts[0, i, j + p] = self.least_rise
                            contacts[1, i, j + p] = sqrt(self.steep[p])
                            if contacts[1, i, j + p] <= self.most_tilt:
                                contacts[0, i, j + p] = self.find_rise(cell + p, p)
            PyErr_CheckSignals()  # The user can interrupt a large map.

    def find_planes(self, cell: cython.Py_ssize_t) -> None:
        """Find the resting planes and the pyramids below them at the grid points of a span.

        ``cell``: column of ``ground`` of the cell north-east of the first grid point.
        """
        cython.declare(i=cython.Py_ssize_t, k=cython.Py_ssize_t, p=cython.Py_ssize_t)
        cython.declare(x=cython.double, y=cython.double, u=cython.double, v=cython.double)
        headings: cython.Py_ssize_t = self.cos.shape[0]
        corner: cython.double = self.corner
        for k in range(4 * headings):
            i, u, v = cell + self.pad_cell[k], self.pad_x[k], self.pad_y[k]
            for p in range(SPAN):
                x, y = self.ground[1, i + p] * u, self.ground[2, i + p] * v
                self.pad_z[k * SPAN + p] = self.ground[0, i + p] + x + y
        for p in range(SPAN):
            self.steep[p], self.z_low[p] = 0.0, FAR
            self.z_east[p] = self.z_west[p] = self.z_north[p] = self.z_south[p] = FAR
        for k in range(headings):
            cos, sin, i = self.cos[k], self.sin[k], k * SPAN
            for p in range(SPAN):
                east, north = self.pad_z[i + p], self.pad_z[headings * SPAN + i + p]
                west = self.pad_z[2 * headings * SPAN + i + p]
                south = self.pad_z[3 * headings * SPAN + i + p]
                z = 0.5 * max(east + west, north + south)
                # On the diagonal that carries the vehicle both differences are the same.
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

    def find_rise(self, cell: cython.Py_ssize_t, p: cython.Py_ssize_t) -> cython.double:
        """Greatest rise of ground over the resting planes, m, or ``least_rise`` if that is more.

        ``cell``: of the grid point, as for `find_planes`; ``p``: its place in the span.
        """
        cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
        cython.declare(half=cython.Py_ssize_t, corner=cython.Py_ssize_t)
        low: cython.double = self.z_low[p]
        east, west = self.z_east[p] - low, self.z_west[p] - low
        north, south = self.z_north[p] - low, self.z_south[p] - low
        for j in range(2 * self.reach):
            share = self.share[j]
            self.bound_x[j] = share * (west if j < self.reach else east)
            self.bound_y[j] = share * (south if j < self.reach else north) + low
        rise = self.least_rise
        for i in range(0, 2 * self.reach, 2):
            corner = cell + (i - self.reach) * self.width - self.reach
            half = max(self.half[i], self.half[i + 1])
            level = min(self.bound_y[i], self.bound_y[i + 1]) + rise
            for j in range(self.reach - half, self.reach + half, 2):
                if self.top[corner + j] - min(self.bound_x[j], self.bound_x[j + 1]) > level:
                    for k in range(4):
                        rise = self.raise_to(rise, cell, p, i + k // 2, j + k % 2)
                    level = min(self.bound_y[i], self.bound_y[i + 1]) + rise
        return rise

    def raise_to(
        self,
        rise: cython.double,
        cell: cython.Py_ssize_t,
        p: cython.Py_ssize_t,
        i: cython.Py_ssize_t,
        j: cython.Py_ssize_t,
    ) -> cython.double:
        """The greater of ``rise`` and the rise of one cell over the resting planes, m."""
        cython.declare(k=cython.Py_ssize_t, one=cython.Py_ssize_t)
        z = self.ground[3, cell + (i - self.reach) * self.width + j - self.reach]
        inside: cython.bint = self.reach - self.half[i] <= j < self.reach + self.half[i]
        if not inside or z - self.bound_x[j] - self.bound_y[i] <= rise:
            return rise
        u, v, other = self.offset[j], self.offset[i], rise
        for k in range(self.cos.shape[0]):
            height, one = z - self.plane_z[k * SPAN + p], 2 * k * SPAN + p
            rise = max(rise, height - self.plane_x[one] * u - self.plane_y[one] * v)
            one += SPAN
            other = max(other, height - self.plane_x[one] * u - self.plane_y[one] * v)
        return max(rise, other)
