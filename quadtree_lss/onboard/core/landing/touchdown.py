# SPDX-License-Identifier: Apache-2.0
"""The lander's four pads set down on the leaf planes, block by block of grid points.

At every grid point the lander stands on its pads at a number of headings. Four rigid pads on
uneven ground rock about the diagonal that carries: the plane through the higher diagonal and
either of the other two pads. Each such plane must be level enough, and no ground under the lander
may rise above it by more than the roughness limit.

Grid points are judged in blocks, whose ground is taken over a plane near it: small numbers for
single precision, and bounds that leave few cells to compare. What is reckoned at each of them is so
for all at once; only cells in the way are looked at one by one.

The lowest of the resting planes at a point is concave, and bounds what the others may find: with
``sink`` the depth of the lowest plane under the grid point and ``fall`` what it falls at the most
per metre from there to the corner of a diamond about the cells (east, west, north or south of the
grid point), a cell of height z at x, y rises by no more than

    z + sink + |x| fall_x + |y| fall_y.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians, tan

import cython
import numpy as np
from cython.cimports.libc.math import fabs, sqrt

from quadtree_lss.onboard.arrays import Array, Bytes, Mask, Single
from quadtree_lss.onboard.config.limits import YAWS
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.lattice import disc
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.tree import cell_map
from quadtree_lss.onboard.core.tree.domain import Domain, carried

if cython.compiled:
    from cython.cimports.cpython.exc import PyErr_CheckSignals
else:  # otherwise from the .pxd
    BLOCK, POINTS, PLANES, FAR = 8, 64, 24, 1e9

    def PyErr_CheckSignals() -> None:
        """Python sees to signals by itself."""


SHAPE = cython.declare(cython.double, cell_map.SHAPE)
NAN = cython.declare(cython.double, float("nan"))


@dataclass(frozen=True)
class Limits:
    """Between which worst contacts of a lander are found: beyond, less or more is the same.
    ``rise``: least and greatest rise of ground over a resting plane, m. ``slope``: least and
    greatest slope of a resting plane, rise over run."""

    rise: tuple[float, float]
    slope: tuple[float, float]


@dataclass(frozen=True)
class WorstContact:
    """How badly the lander stands at its worst heading, (n + 1, n + 1), within `Limits`. ``rise``:
    greatest rise of ground under the lander over a resting plane, m; NaN where nobody asked.
    ``slope``: of the steepest resting plane, rise over run; NaN where nobody asked."""

    rise: Single
    slope: Single


class TouchdownCheck:
    """Sets the lander down on maps of a growing terrain.

    How it stands in a block of grid points depends on the cells that its landers can meet alone, so
    blocks where none of them changed are as before, bit for bit. ``config``: the lander.
    ``limits``: between which contacts are found; by default the touchdown limits alone.
    """

    def __init__(self, config: LssConfig, limits: Limits | None = None) -> None:
        self.config = config
        self.steepest = tan(radians(config.vehicle.lengths.touchdown_slope_deg))
        within = (config.vehicle.lengths.touchdown_roughness,) * 2, (self.steepest,) * 2
        self.limits = limits or Limits(*within)
        self._set_for: tuple[Domain, float | None] | None = None

    def worst(
        self, raster: TerrainRaster, candidates: Mask, heading: float | None = None
    ) -> WorstContact:
        """The worst contact at grid points.

        One that is too steep for the limits is not looked at for what rises over it.

        Args:
            raster: The map on its finest cells.
            candidates: (n + 1, n + 1) points to check; their lander circle lies inside the domain.
            heading: Of the lander, about z from x, rad; None for all `YAWS`.
        """
        if not candidates.any():  # of a lander wider than the domain the window would be wider, too
            return WorstContact(*np.full((2, *candidates.shape), np.nan, dtype=np.float32))
        self._set(raster.domain, heading, candidates.shape)
        changed = np.zeros(raster.leaf.shape, dtype=np.uint8)
        layers = raster.elevation, raster.slope_x, raster.slope_y, raster.subscale
        self._blocks.take(*layers, changed)
        self._blocks.judge(candidates.view(np.uint8), changed, self._worst)
        return WorstContact(*self._worst)

    def _set(self, domain: Domain, heading: float | None, shape: tuple[int, ...]) -> None:
        """Be ready for a domain: what was found on one that was moved is still there."""
        if self._set_for == (domain, heading):
            return
        moved = None
        if self._set_for is not None and self._set_for[1] == heading:
            moved = self._set_for[0].cells_to(domain)
        self._set_for = domain, heading
        if moved is None or moved[0] % BLOCK or moved[1] % BLOCK:
            self._blocks = Blocks(self.config, self.limits, domain, heading)
            self._worst = np.full((2, *shape), np.nan, dtype=np.float32)
            return
        rim = self._blocks.follow(*moved)
        self._worst = carried(self._worst, *moved, np.nan)
        self._worst[..., :rim] = self._worst[..., -rim:] = np.nan
        self._worst[:, :rim] = self._worst[:, -rim:] = np.nan  # nobody asks for these any more

    def over(self, worst: WorstContact) -> Mask:
        """Where a contact is over the touchdown limits."""
        high = worst.rise > np.float32(self.config.vehicle.lengths.touchdown_roughness)
        return np.asarray(high | (worst.slope > np.float32(self.steepest)))


@cython.boundscheck(False)
class Blocks:
    """The lander, and the ground about one block of grid points at a time.

    Attributes:
        ground: (2, N, N) finest cells, those at the border repeated outside so that blocks fit:
            height of a pad at the cell's centre (it stands on the highest ground within its
            radius), and the highest ground: plane, its rise to the corner, subscale feature (a bell
            fitted to part of a rock is low, so its own height counts and not the rock's).
        slopes: (2, N, N) of them, in x and y.
        reach: Cells from a grid point to the farthest that the lander at it can meet.
        width: Cells along the window of a block.
        offset: (width,) of their centres from the window's, m.
        pad_row, pad_column: (2 PLANES,) of the cell that a pad stands on, from that of the cell
            north-east of the grid point; four pads around the circle, heading by heading.
        pad_x, pad_y: (2 PLANES,) of the pad from that cell's centre, m.
        half: (2 reach,) half width of the disc of cells under the lander in each column, in cells.
        first: Column of the first of these.
        top, pad: (width^2,) window over the block's plane: highest ground of each cell, height of a
            pad at its centre.
        stand: (2 PLANES POINTS,) heights of the pads at each grid point, over the plane, m.
        planes_x, planes_y: (PLANES POINTS,) slopes of the resting planes at each grid point, over
            the block's plane; for each heading, of one point after the other, both of them.
        planes_z: (PLANES / 2 POINTS,) their heights there, which two have in common, m.
        steep: (POINTS,) square of the slope of the steepest.
        sink, fall_east, fall_west, fall_north, fall_south: (POINTS,) bounds of the planes, m, m/m.
        run: (BLOCK width,) highest ground of runs of cells along a column, m.
        highest: (2 reach POINTS,) highest ground in each column of the cells under the lander, then
            by how much it may rise over a resting plane, m.
        most: (POINTS,) greatest of these rises, m.
        rounding: Bounds find nothing by less than single precision can err, m.
        middle, away: (2 reach,) of these cells from the grid point, and that without a sign, m.
        aside: (2 reach,) farthest of a column of them from its middle, m.
        corner: Of the diamond about them from the grid point, m.
        resting_x, resting_y, resting_z: (PLANES,) resting planes at the grid point at hand.
        tilt: (2 reach,) what there bounds the rise of each row of cells by its place alone, m.
        columns: (2 reach,) those of its cells that may be in the way, as many as there are.
        cos, sin: (PLANES / 2,) of the headings, over the radius.
        worst_rise, worst_slope: Worst found there.
        spoiler_row, spoiler_column: Of the cell in the window that was last found in the way.
        base_x, base_y: Slopes of the block's plane.
    """

    def __init__(
        self, config: LssConfig, limits: Limits, domain: Domain, heading: float | None
    ) -> None:
        side = domain.finest_size
        under = disc(0.5 * config.vehicle.diameter, side)
        self.side, self.radius = side, 0.5 * config.vehicle.diameter
        self.pad_radius = config.vehicle.pad_radius
        self.rounding = 1e-4 * config.vehicle.size
        self.low_rise, self.high_rise = limits.rise
        self.low_slope, self.high_slope = limits.slope
        self.reach = max(int(np.floor(self.radius / side)) + 1, under.reach)
        self.width = BLOCK - 1 + 2 * self.reach
        self.offset = (np.arange(self.width) - 0.5 * (self.width - 1)) * side
        self.blocks = domain.finest_count // BLOCK + 1
        around = self.blocks * BLOCK - 1 + 2 * self.reach
        self.ground = np.full((2, around, around), np.nan)
        self.slopes = np.full((2, around, around), np.nan, dtype=np.float32)
        yaw = np.arange(YAWS) * (0.5 * np.pi / YAWS) if heading is None else np.array([heading])
        assert 2 * len(yaw) <= PLANES
        yaw = np.resize(yaw, PLANES // 2)  # fewer are looked at more than once
        c, s = np.cos(yaw), np.sin(yaw)
        self.cos, self.sin = ((v / self.radius).astype(np.float32) for v in (c, s))
        x = self.radius * np.stack([c, -s, -c, s], axis=1).ravel()
        y = self.radius * np.stack([s, c, -s, -c], axis=1).ravel()
        column, row = np.floor(x / side).astype(np.intp), np.floor(y / side).astype(np.intp)
        self.pad_row, self.pad_column = row, column
        self.pad_x = (x - (column + 0.5) * side).astype(np.float32)
        self.pad_y = (y - (row + 0.5) * side).astype(np.float32)
        half = np.zeros(2 * self.reach, dtype=np.intp)
        np.maximum.at(half, under.column + self.reach, under.row + 1)
        self.half, self.first = half, int(np.argmax(half > 0))
        self.top, self.pad = np.zeros((2, self.width**2), dtype=np.float32)
        self.run = np.zeros(BLOCK * self.width, dtype=np.float32)
        self.highest = np.zeros(2 * self.reach * POINTS, dtype=np.float32)
        self.middle = ((np.arange(-self.reach, self.reach) + 0.5) * side).astype(np.float32)
        self.away = np.abs(self.middle)
        self.aside = (np.maximum(half - 0.5, 0.0) * side).astype(np.float32)
        self.tilt, self.columns = np.zeros_like(self.away), np.zeros_like(half)
        self.corner = float((np.abs(under.x) + np.abs(under.y)).max())
        if not cython.compiled:  # otherwise parts of the object
            self.resting_x, self.resting_y, self.resting_z = np.zeros((3, PLANES), np.float32)
            self.stand = np.zeros(2 * PLANES * POINTS, np.float32)
            size = 3, PLANES * POINTS
            self.planes_x, self.planes_y, self.planes_z = np.zeros(size, np.float32)
            self.fall_east, self.fall_west, self.fall_north = np.zeros((3, POINTS), np.float32)
            self.fall_south, self.sink, self.most = np.zeros((3, POINTS), np.float32)
            self.steep = np.zeros(POINTS, np.float32)
        self.worst_rise = self.worst_slope = 0.0
        self.spoiler_row = self.spoiler_column = 0
        self.base_x = self.base_y = 0.0

    def follow(self, east: int, north: int) -> int:
        """The ground of the domain that lies so many finest cells farther, whole blocks. Grid
        points so near to the first and last column are to be judged anew, for `take` does not
        compare what is repeated beside these."""
        self.ground = carried(np.asarray(self.ground), east, north, NAN)
        self.slopes = carried(np.asarray(self.slopes), east, north, NAN)
        return self.reach + BLOCK

    @cython.locals(elevation=cython.double[:, ::1], slope_x=cython.double[:, ::1])
    @cython.locals(slope_y=cython.double[:, ::1], subscale=cython.double[:, ::1])
    @cython.locals(changed=cython.uchar[:, ::1], ground=cython.double[:, :, ::1])
    @cython.locals(slopes=cython.float[:, :, ::1], east_up=cython.float, north_up=cython.float)
    def take(
        self, elevation: Array, slope_x: Array, slope_y: Array, subscale: Array, changed: Bytes
    ) -> None:
        """Take the ground of a map, (n, n) each: height, slopes and features of finest cells.

        Marks in ``changed`` (n, n) where it is not that of the map before.
        """
        cython.declare(i=cython.Py_ssize_t, k=cython.Py_ssize_t, r=cython.Py_ssize_t)
        cython.declare(c=cython.Py_ssize_t, same=cython.bint)
        n: cython.Py_ssize_t = elevation.shape[0]
        first: cython.Py_ssize_t = self.reach
        after: cython.Py_ssize_t = self.reach + n
        half, ground, slopes = 0.5 * self.side, self.ground, self.slopes
        with cython.nogil:
            for i in range(ground.shape[1]):
                r = min(max(i - first, 0), n - 1)
                for c in range(n):
                    k = first + c
                    x, y, z = slope_x[r, c], slope_y[r, c], elevation[r, c]
                    pad = z + self.pad_radius * sqrt(x * x + y * y)
                    top = z + half * (fabs(x) + fabs(y)) + SHAPE * subscale[r, c]
                    east_up, north_up = x, y
                    same = ground[0, i, k] == pad and ground[1, i, k] == top
                    if not (same and slopes[0, i, k] == east_up and slopes[1, i, k] == north_up):
                        ground[0, i, k], ground[1, i, k] = pad, top
                        slopes[0, i, k], slopes[1, i, k] = east_up, north_up
                        changed[r, c] = True
                for k in range(2):
                    ground[k, i, :first] = ground[k, i, first]
                    ground[k, i, after:] = ground[k, i, after - 1]
                    slopes[k, i, :first] = slopes[k, i, first]
                    slopes[k, i, after:] = slopes[k, i, after - 1]

    @cython.locals(due=cython.uchar[:, ::1], changed=cython.uchar[:, ::1])
    @cython.locals(worst=cython.float[:, :, ::1])
    def judge(self, due: Bytes, changed: Bytes, worst: Single) -> None:
        """Bring the worst contacts up to date after `take`.

        Args:
            due: (n + 1, n + 1) points that need one.
            changed: (n, n) cells whose ground is not that of the map before.
            worst: (2, n + 1, n + 1) worst rise and slope there, NaN if unknown, changed in place.
        """
        cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
        cython.declare(south=cython.Py_ssize_t, west=cython.Py_ssize_t, block=cython.Py_ssize_t)
        cython.declare(forget=cython.bint)
        n: cython.Py_ssize_t = changed.shape[0]
        columns = cython.declare(cython.uchar[::1], np.zeros(n, dtype=np.uint8))
        for block in range(self.blocks):
            south = block * BLOCK - self.reach
            with cython.nogil:
                columns[:] = 0
                for i in range(max(south, 0), min(south + self.width, n)):
                    for j in range(n):
                        columns[j] |= changed[i, j]
                for k in range(self.blocks):
                    west = k * BLOCK - self.reach
                    forget = False
                    for j in range(max(west, 0), min(west + self.width, n)):
                        forget |= columns[j]
                    self.judge_block(due, forget, worst, block * BLOCK, k * BLOCK)
            PyErr_CheckSignals()  # one can end it

    def judge_block(
        self,
        due: Bytes,
        forget: cython.bint,
        worst: Single,
        row: cython.Py_ssize_t,
        column: cython.Py_ssize_t,
    ) -> None:
        """`judge` for the grid points of the block that begins at one."""
        cython.declare(r=cython.Py_ssize_t, c=cython.Py_ssize_t)
        loaded: cython.bint = False
        for r in range(row, min(row + BLOCK, due.shape[0])):
            for c in range(column, min(column + BLOCK, due.shape[1])):
                if forget:
                    worst[1, r, c] = NAN
                if not due[r, c] or worst[1, r, c] == worst[1, r, c]:
                    continue
                if not loaded:
                    self.load(row, column)
                    self.place_pads(row, column)
                    self.find_planes()
                    self.cover()
                    self.bound_rises()
                    loaded = True
                self.find_worst(r - row, c - column)
                worst[0, r, c], worst[1, r, c] = self.worst_rise, self.worst_slope

    def load(self, row: cython.Py_ssize_t, column: cython.Py_ssize_t) -> None:
        """Take the ground of the window that begins at a cell.

        The plane is one of least squares, through every other cell; any would do.
        """
        cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
        w: cython.Py_ssize_t = self.width
        count, level, along_x, along_y, square = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(0, w, 2):
            for j in range(0, w, 2):
                z = self.ground[0, row + i, column + j]
                count += 1.0
                level += z
                along_x += self.offset[j] * z
                along_y += self.offset[i] * z
                square += self.offset[j] * self.offset[j]
        level /= count
        slope_x, slope_y = along_x / square, along_y / square
        for i in range(w):
            base = level + self.offset[i] * slope_y
            for j in range(w):
                z = base + self.offset[j] * slope_x
                self.pad[i * w + j] = self.ground[0, row + i, column + j] - z
                self.top[i * w + j] = self.ground[1, row + i, column + j] - z
        self.base_x, self.base_y = slope_x, slope_y

    def place_pads(self, row: cython.Py_ssize_t, column: cython.Py_ssize_t) -> None:
        """Heights of the pads about every grid point of the block that begins at one."""
        cython.declare(k=cython.Py_ssize_t, i=cython.Py_ssize_t, j=cython.Py_ssize_t)
        cython.declare(r=cython.Py_ssize_t, c=cython.Py_ssize_t, place=cython.Py_ssize_t)
        # Numbers, for Cython 3.0 takes no names here: 64 is POINTS.
        height = cython.declare(cython.float[64])
        rise: cython.float
        for k in range(2 * PLANES):
            x, y = self.pad_x[k], self.pad_y[k]
            rise = self.base_x * x + self.base_y * y
            for i in range(BLOCK):
                r, c = self.reach + i + self.pad_row[k], self.reach + self.pad_column[k]
                place = r * self.width + c
                r, c = row + r, column + c
                for j in range(BLOCK):
                    z = self.slopes[0, r, c + j] * x + self.slopes[1, r, c + j] * y
                    height[i * BLOCK + j] = self.pad[place + j] + (z - rise)
            for i in range(POINTS):
                self.stand[k * POINTS + i] = height[i]

    def find_planes(self) -> None:
        """The resting planes at every grid point, two for each heading, and their bounds.

        One end of the diagonal that carries is as far over its middle as the other is under: the
        rise over a radius, in the heading and across it, of the one plane and the other.
        """
        cython.declare(k=cython.Py_ssize_t, p=cython.Py_ssize_t)
        cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
        cython.declare(x=cython.float, y=cython.float, u=cython.float, v=cython.float)
        cython.declare(along=cython.float, across=cython.float)
        half: cython.float = 0.5
        corner: cython.float = self.corner
        east_up: cython.float = self.base_x
        north_up: cython.float = self.base_y
        for p in range(POINTS):
            self.steep[p], self.sink[p] = 0.0, -FAR
            self.fall_east[p] = self.fall_west[p] = -FAR
            self.fall_north[p] = self.fall_south[p] = -FAR
        for k in range(PLANES // 2):
            i, j = 4 * k * POINTS, 2 * k * POINTS
            cos, sin = self.cos[k], self.sin[k]
            for p in range(POINTS):
                east, north = self.stand[i + p], self.stand[i + POINTS + p]
                west, south = self.stand[i + 2 * POINTS + p], self.stand[i + 3 * POINTS + p]
                centre = half * max(east + west, north + south)
                along, across = east - centre, north - centre
                x, y = along * cos - across * sin, along * sin + across * cos
                along, across = centre - west, centre - south
                u, v = along * cos - across * sin, along * sin + across * cos
                self.planes_x[j + 2 * p], self.planes_x[j + 2 * p + 1] = x, u
                self.planes_y[j + 2 * p], self.planes_y[j + 2 * p + 1] = y, v
                self.planes_z[k * POINTS + p] = centre
                low = -centre
                self.sink[p] = max(self.sink[p], low)
                self.fall_east[p] = max(self.fall_east[p], low - corner * min(x, u))
                self.fall_west[p] = max(self.fall_west[p], low + corner * max(x, u))
                self.fall_north[p] = max(self.fall_north[p], low - corner * min(y, v))
                self.fall_south[p] = max(self.fall_south[p], low + corner * max(y, v))
                x, y = x + east_up, y + north_up
                u, v = u + east_up, v + north_up
                self.steep[p] = max(self.steep[p], max(x * x + y * y, u * u + v * v))
        for p in range(POINTS):
            self.fall_east[p] = (self.fall_east[p] - self.sink[p]) / corner
            self.fall_west[p] = (self.fall_west[p] - self.sink[p]) / corner
            self.fall_north[p] = (self.fall_north[p] - self.sink[p]) / corner
            self.fall_south[p] = (self.fall_south[p] - self.sink[p]) / corner

    def cover(self) -> None:
        """Highest ground under the lander at every grid point, column by column.

        A disc is a row of centred runs of cells.
        """
        cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
        cython.declare(half=cython.Py_ssize_t, south=cython.Py_ssize_t, north=cython.Py_ssize_t)
        cython.declare(here=cython.Py_ssize_t, place=cython.Py_ssize_t)
        self.run[:] = -FAR
        for half in range(1, self.reach + 1):
            south, north = (self.reach - half) * self.width, (self.reach + half - 1) * self.width
            for i in range(BLOCK * self.width):
                z = max(self.top[south + i], self.top[north + i])
                self.run[i] = max(self.run[i], z)
            for j in range(self.first, 2 * self.reach - self.first):
                if self.half[j] == half:
                    for i in range(BLOCK):
                        here, place = j * POINTS + i * BLOCK, i * self.width + j
                        for k in range(BLOCK):
                            self.highest[here + k] = self.run[place + k]

    def bound_rises(self) -> None:
        """By how much ground may rise over a resting plane at the grid points, column by column."""
        cython.declare(j=cython.Py_ssize_t, p=cython.Py_ssize_t, here=cython.Py_ssize_t)
        aside = cython.declare(cython.float[64])
        level = cython.declare(cython.float[64])
        rounding: cython.float = self.rounding
        least: cython.float = 0.0
        for p in range(POINTS):
            aside[p] = max(max(self.fall_south[p], self.fall_north[p]), least)
            level[p] = self.sink[p] + rounding
            self.most[p] = -FAR
        for j in range(self.first, 2 * self.reach - self.first):
            away, wide, here = self.away[j], self.aside[j], j * POINTS
            for p in range(POINTS):
                fall = self.fall_west[p] if j < self.reach else self.fall_east[p]
                z = self.highest[here + p] + (wide * aside[p] + (away * fall + level[p]))
                self.highest[here + p] = z
                self.most[p] = max(self.most[p], z)

    def find_worst(self, row: cython.Py_ssize_t, column: cython.Py_ssize_t) -> None:
        """Find the worst contact of the lander at a grid point of the block."""
        place: cython.Py_ssize_t = row * BLOCK + column
        self.worst_rise = self.low_rise
        self.worst_slope = max(self.low_slope, sqrt(self.steep[place]))
        if self.worst_slope <= self.high_slope and self.most[place] > self.low_rise:
            self.find_rise(row, column)

    def find_rise(self, row: cython.Py_ssize_t, column: cython.Py_ssize_t) -> None:
        """Set the lander at a grid point over the cells that may be in its way.

        Until one rises over the limit: by how much does not matter.
        """
        cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
        cython.declare(place=cython.Py_ssize_t, fall=cython.float, deep=cython.float)
        cython.declare(low=cython.float, high=cython.float, m=cython.Py_ssize_t)
        point: cython.Py_ssize_t = row * BLOCK + column
        width: cython.Py_ssize_t = self.width
        reach: cython.Py_ssize_t = self.reach
        count: cython.Py_ssize_t = 0
        for k in range(PLANES // 2):
            i = k * POINTS + point
            self.resting_x[2 * k] = self.planes_x[2 * i]
            self.resting_x[2 * k + 1] = self.planes_x[2 * i + 1]
            self.resting_y[2 * k] = self.planes_y[2 * i]
            self.resting_y[2 * k + 1] = self.planes_y[2 * i + 1]
            self.resting_z[2 * k] = self.resting_z[2 * k + 1] = self.planes_z[i]
        south: cython.float = self.fall_south[point]
        north: cython.float = self.fall_north[point]
        for i in range(reach):
            self.tilt[i] = self.away[i] * south
            self.tilt[reach + i] = self.away[reach + i] * north
        # What is in the way of one grid point mostly is of the next.
        i, j = self.spoiler_row - row, self.spoiler_column - column
        worst: cython.float = self.worst_rise
        if 0 <= j < 2 * reach and -self.half[j] <= i - reach < self.half[j]:
            worst = self.rise_at(row, column, i, j, worst)
        level: cython.float = self.sink[point] + self.rounding
        limit: cython.float = self.high_rise
        # Nobody foresees which columns these are: collected without a branch.
        for j in range(self.first, 2 * reach - self.first):
            self.columns[count] = j
            count += self.highest[j * POINTS + point] > worst
        for k in range(count):
            j = self.columns[k]
            if self.highest[j * POINTS + point] <= worst:
                continue
            fall = self.fall_west[point] if j < reach else self.fall_east[point]
            deep = self.away[j] * fall + level
            place = row * width + column + j
            for i in range(reach - self.half[j], reach + self.half[j], 2):
                low = self.top[place + i * width] + self.tilt[i]
                high = self.top[place + (i + 1) * width] + self.tilt[i + 1]
                if max(low, high) + deep <= worst:
                    continue
                for m in range(2):
                    low = high if m else low
                    if low + deep <= worst:
                        continue
                    worst = self.rise_at(row, column, i + m, j, worst)
                    if worst > limit:
                        self.worst_rise = worst
                        return
        self.worst_rise = worst

    def rise_at(
        self,
        row: cython.Py_ssize_t,
        column: cython.Py_ssize_t,
        i: cython.Py_ssize_t,
        j: cython.Py_ssize_t,
        worst: cython.float,
    ) -> cython.float:
        """By how much a cell under the lander rises over the resting planes, or others do, m."""
        k: cython.Py_ssize_t
        north: cython.float = self.middle[i]
        east: cython.float = self.middle[j]
        height: cython.float = self.top[(row + i) * self.width + column + j]
        above = cython.declare(cython.float[24])
        for k in range(PLANES):
            above[k] = (
                height - self.resting_x[k] * east - self.resting_y[k] * north - self.resting_z[k]
            )
        rise: cython.float = greatest(above)
        if rise > worst:
            self.spoiler_row, self.spoiler_column = row + i, column + j
            return rise
        return worst


def greatest(values: cython.p_float) -> cython.float:
    """Of (PLANES,) values."""
    k: cython.Py_ssize_t
    half = cython.declare(cython.float[24])
    least = cython.declare(cython.float[24])
    for k in range(PLANES // 2):
        half[k] = max(values[k], values[k + PLANES // 2])
    for k in range(PLANES // 6):
        least[k] = max(half[k], max(half[k + PLANES // 6], half[k + PLANES // 3]))
    return max(max(least[0], least[1]), max(least[2], least[3]))
