# SPDX-License-Identifier: Apache-2.0
"""The lander's four pads set down on the leaf planes, block by block of grid points.

At every grid point the lander stands on its pads at a number of headings. Four rigid pads on
uneven ground rock about the diagonal that carries: the plane through the higher diagonal and
either of the other two pads. Each such plane must be level enough, and no ground under the lander
may rise above it by more than the roughness limit.

Grid points are judged in blocks, whose ground is taken over a plane near it: small numbers for
single precision, and bounds that leave few cells to compare. Over that plane let all pads of a
grid point stand between ``low`` and ``high``, h apart. A resting plane holds both ends of a
diagonal, at c on average and not lower than the other two, and one pad of the other. At a point of
the circle, alpha and beta radii along the two diagonals, it stands at c (1 - alpha - beta) +
alpha e + beta n, with e one end and n a pad or the mirror image of one. As c <= (e + high) / 2 and
alpha + beta <= sqrt 2,

    plane >= low - h (sqrt 2 - 1) / 2 =: floor    and    its slope <= h / radius.

Ground that is not higher over the floor than the limit is in the way at no heading.

Where some is, the lowest of the resting planes at a point, which is concave, bounds what the others
may find: with ``sink`` the depth of the lowest plane under the grid point and ``fall`` what it
falls at the most per metre from there to the corner of a diamond about the cells (east, west, north
or south of the grid point), a cell of height z at x, y rises by no more than

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


#: Bounds find nothing by less than single precision can err, rise over run.
SLOPE_ROUNDING = cython.declare(cython.double, 1e-4)
#: Where a resting plane may sink below the lowest pad, as a share of the pads' spread.
SAG = cython.declare(cython.double, 0.5 * (2.0**0.5 - 1.0))
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

    def over(self, worst: WorstContact) -> Mask:
        """Where a contact is over the touchdown limits."""
        high = worst.rise > np.float32(self.config.vehicle.lengths.touchdown_roughness)
        return np.asarray(high | (worst.slope > np.float32(self.steepest)))


@cython.boundscheck(False)
class Blocks:
    """The lander, and the ground about one block of grid points at a time.

    Attributes:
        ground: (4, N, N) finest cells, those at the border repeated outside so that blocks fit:
            height of a pad at the cell's centre (it stands on the highest ground within its
            radius), slopes in x and y, and the highest ground: plane, its rise to the corner,
            subscale feature (a bell fitted to part of a rock is low, so its own height counts and
            not the rock's).
        reach: Cells from a grid point to the farthest that the lander at it can meet.
        width: Cells along the window of a block.
        offset: (width,) of their centres from the window's, m.
        pad_place: (4 yaws,) place in the window of the cell that a pad stands on, from that of the
            cell north-east of the grid point; four pads around the circle, heading by heading.
        pad_x, pad_y: (4 yaws,) of the pad from that cell's centre, m.
        half: (2 reach,) half width of the disc of cells under the lander in each row, in cells.
        top, pad, slope_x, slope_y: (width^2,) window over the block's plane: highest ground of
            each cell, height of a pad at its centre, slopes.
        stand: (4 yaws POINTS,) heights of the pads at each grid point, over the plane, m.
        floor: (POINTS,) below every resting plane of a grid point, over the plane, m.
        spread: (POINTS,) of the pads' heights, m.
        rounding: Bounds find nothing by less than single precision can err, m.
        roof: (POINTS,) highest ground under the lander, over the plane, m.
        highest: (2 reach POINTS,) in each row of the cells under it, m.
        middle, away: (2 reach,) of these cells from the grid point, and that without a sign, m.
        aside: (2 reach,) farthest of a row of them from its middle, m.
        corner: Of the diamond about them from the grid point, m.
        resting_x, resting_y, resting_z: (PLANES,) resting planes at the grid point at hand: slopes
            and height there, over the block's plane.
        cos, sin: (2 yaws,) of the headings, over the radius.
        sink, fall_east, fall_west, fall_north, fall_south: Bounds of the planes, m, m/m.
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
        self.yaws = YAWS if heading is None else 1
        assert 2 * self.yaws <= PLANES
        self.reach = max(int(np.floor(self.radius / side)) + 1, under.reach)
        self.width = BLOCK - 1 + 2 * self.reach
        self.offset = (np.arange(self.width) - 0.5 * (self.width - 1)) * side
        self.blocks = domain.finest_count // BLOCK + 1
        around = self.blocks * BLOCK - 1 + 2 * self.reach
        self.ground = np.full((4, around, around), np.nan)
        # Cells beyond the circle may stand under the floor: then every one is compared.
        self.bounded = float(np.hypot(under.x, under.y).max()) <= self.radius
        yaw = (heading or 0.0) + np.arange(self.yaws) * (0.5 * np.pi / self.yaws)
        c, s = np.cos(yaw), np.sin(yaw)
        self.cos, self.sin = (np.tile(v / self.radius, 2).astype(np.float32) for v in (c, s))
        x = self.radius * np.stack([c, -s, -c, s], axis=1).ravel()
        y = self.radius * np.stack([s, c, -s, -c], axis=1).ravel()
        column, row = np.floor(x / side).astype(np.intp), np.floor(y / side).astype(np.intp)
        self.pad_place = row * self.width + column
        self.pad_x = (x - (column + 0.5) * side).astype(np.float32)
        self.pad_y = (y - (row + 0.5) * side).astype(np.float32)
        half = np.zeros(2 * self.reach, dtype=np.intp)
        np.maximum.at(half, under.row + self.reach, under.column + 1)
        self.half = half
        self.top, self.pad, self.slope_x, self.slope_y = np.zeros(
            (4, self.width**2), dtype=np.float32
        )
        self.run = np.zeros(self.width * BLOCK, dtype=np.float32)
        self.stand = np.zeros(4 * self.yaws * POINTS, dtype=np.float32)
        self.floor, self.spread, self.roof = np.zeros((3, POINTS), dtype=np.float32)
        self.highest = np.zeros(2 * self.reach * POINTS, dtype=np.float32)
        self.middle = ((np.arange(-self.reach, self.reach) + 0.5) * side).astype(np.float32)
        self.away = np.abs(self.middle)
        self.aside = (np.maximum(half - 0.5, 0.0) * side).astype(np.float32)
        self.corner = float((np.abs(under.x) + np.abs(under.y)).max())
        if not cython.compiled:  # otherwise parts of the object
            self.resting_x, self.resting_y, self.resting_z = np.zeros((3, PLANES), np.float32)
        self.sink = self.fall_east = self.fall_west = self.fall_north = self.fall_south = 0.0
        self.worst_rise = self.worst_slope = 0.0
        self.spoiler_row = self.spoiler_column = 0
        self.base_x = self.base_y = 0.0

    def follow(self, east: int, north: int) -> int:
        """The ground of the domain that lies so many finest cells farther, whole blocks. Grid
        points so near to the first and last column are to be judged anew, for `take` does not
        compare what is repeated beside these."""
        self.ground = carried(np.asarray(self.ground), east, north, NAN)
        return self.reach + BLOCK

    @cython.locals(elevation=cython.double[:, ::1], slope_x=cython.double[:, ::1])
    @cython.locals(slope_y=cython.double[:, ::1], subscale=cython.double[:, ::1])
    @cython.locals(changed=cython.uchar[:, ::1], ground=cython.double[:, :, ::1])
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
        half, ground = 0.5 * self.side, self.ground
        with cython.nogil:
            for i in range(ground.shape[1]):
                r = min(max(i - first, 0), n - 1)
                for c in range(n):
                    k = first + c
                    x, y, z = slope_x[r, c], slope_y[r, c], elevation[r, c]
                    pad = z + self.pad_radius * sqrt(x * x + y * y)
                    top = z + half * (fabs(x) + fabs(y)) + SHAPE * subscale[r, c]
                    same = ground[0, i, k] == pad and ground[3, i, k] == top
                    if not (same and ground[1, i, k] == x and ground[2, i, k] == y):
                        ground[0, i, k], ground[3, i, k] = pad, top
                        ground[1, i, k], ground[2, i, k] = x, y
                        changed[r, c] = True
                for k in range(4):
                    ground[k, i, :first] = ground[k, i, first]
                    ground[k, i, after:] = ground[k, i, after - 1]

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
                    self.place_pads()
                    self.cover()
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
                self.top[i * w + j] = self.ground[3, row + i, column + j] - z
            for j in range(w):
                self.slope_x[i * w + j] = self.ground[1, row + i, column + j] - slope_x
                self.slope_y[i * w + j] = self.ground[2, row + i, column + j] - slope_y
        self.base_x, self.base_y = slope_x, slope_y

    def place_pads(self) -> None:
        """Heights of the pads about every grid point of the block, and their bounds."""
        cython.declare(k=cython.Py_ssize_t, i=cython.Py_ssize_t, j=cython.Py_ssize_t)
        cython.declare(here=cython.Py_ssize_t, place=cython.Py_ssize_t)
        # Numbers, for Cython 3.0 takes no names here: 64 is POINTS, 24 is PLANES.
        height = cython.declare(cython.float[64])
        lowest = cython.declare(cython.float[64])
        highest = cython.declare(cython.float[64])
        for i in range(POINTS):
            lowest[i], highest[i] = FAR, -FAR
        for k in range(4 * self.yaws):
            x, y = self.pad_x[k], self.pad_y[k]
            for i in range(BLOCK):
                here = i * BLOCK
                place = (self.reach + i) * self.width + self.reach + self.pad_place[k]
                for j in range(BLOCK):
                    z = self.pad[place + j] + self.slope_x[place + j] * x
                    height[here + j] = z + self.slope_y[place + j] * y
            here = k * POINTS
            for i in range(POINTS):
                self.stand[here + i] = height[i]
                lowest[i] = height[i] if height[i] < lowest[i] else lowest[i]
                highest[i] = height[i] if height[i] > highest[i] else highest[i]
        for i in range(POINTS):
            self.spread[i], self.floor[i] = highest[i] - lowest[i], lowest[i]
            self.floor[i] -= SAG * self.spread[i] + self.rounding if self.bounded else FAR

    def cover(self) -> None:
        """Highest ground under the lander at every grid point, in all and row by row.

        A disc is a stack of centred runs of cells.
        """
        cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
        cython.declare(half=cython.Py_ssize_t, place=cython.Py_ssize_t)
        self.run[:] = -FAR
        self.roof[:] = -FAR
        self.highest[:] = -FAR
        for half in range(1, self.reach + 1):
            for i in range(self.width):
                place = i * self.width + self.reach
                k = i * BLOCK
                for j in range(BLOCK):
                    west, east = self.top[place - half + j], self.top[place + half - 1 + j]
                    z = west if west > east else east
                    self.run[k + j] = z if z > self.run[k + j] else self.run[k + j]
            for i in range(2 * self.reach):
                if self.half[i] == half:
                    for k in range(POINTS):
                        z = self.run[i * BLOCK + k]
                        self.highest[i * POINTS + k] = z
                        self.roof[k] = z if z > self.roof[k] else self.roof[k]

    def find_worst(self, row: cython.Py_ssize_t, column: cython.Py_ssize_t) -> None:
        """Find the worst contact of the lander at a grid point of the block."""
        place: cython.Py_ssize_t = row * BLOCK + column
        lowest = self.floor[place] + self.low_rise
        bound = sqrt(self.base_x**2 + self.base_y**2) + self.spread[place] / self.radius
        self.worst_rise, self.worst_slope = self.low_rise, self.low_slope
        under: cython.bint = self.roof[place] > lowest
        if bound <= self.low_slope - SLOPE_ROUNDING and not under:
            return
        self.find_planes(place)
        if self.worst_slope > self.high_slope or not under:
            return
        self.bound_planes()
        self.find_rise(row, column)

    def find_planes(self, place: cython.Py_ssize_t) -> None:
        """The resting planes at a grid point, two for each heading.

        Sets their slopes in x and y and height at the grid point, over the block's plane, and the
        steepest slope.
        """
        cython.declare(k=cython.Py_ssize_t, i=cython.Py_ssize_t)
        n: cython.Py_ssize_t = self.yaws
        east_up: cython.float = self.base_x
        north_up: cython.float = self.base_y
        # One end of the diagonal that carries is as far over its middle as the other is under: the
        # rise over a radius, in the heading and across it, of the one plane and the other.
        east = cython.declare(cython.float[24])
        north = cython.declare(cython.float[24])
        west = cython.declare(cython.float[24])
        south = cython.declare(cython.float[24])
        along = cython.declare(cython.float[24])
        across = cython.declare(cython.float[24])
        square = cython.declare(cython.float[24])
        for k in range(n):
            i = 4 * k * POINTS + place
            east[k], north[k] = self.stand[i], self.stand[i + POINTS]
            west[k], south[k] = self.stand[i + 2 * POINTS], self.stand[i + 3 * POINTS]
        for k in range(n):
            centre: cython.float = 0.5 * max(east[k] + west[k], north[k] + south[k])
            along[k], across[k] = east[k] - centre, north[k] - centre
            along[n + k], across[n + k] = centre - west[k], centre - south[k]
            self.resting_z[k] = self.resting_z[n + k] = centre
        for k in range(2 * n):
            self.resting_x[k] = along[k] * self.cos[k] - across[k] * self.sin[k]
            self.resting_y[k] = along[k] * self.sin[k] + across[k] * self.cos[k]
        for k in range(2 * n, PLANES):  # of one heading alone
            self.resting_x[k], self.resting_y[k] = self.resting_x[0], self.resting_y[0]
            self.resting_z[k] = self.resting_z[0]
        for k in range(PLANES):
            x, y = self.resting_x[k] + east_up, self.resting_y[k] + north_up
            square[k] = x * x + y * y
        self.worst_slope = max(self.worst_slope, sqrt(greatest(square)))

    def bound_planes(self) -> None:
        """Bounds of the resting planes."""
        k: cython.Py_ssize_t
        corner: cython.float = self.corner
        under = cython.declare(cython.float[24])
        for k in range(PLANES):
            under[k] = -self.resting_z[k]
        self.sink = greatest(under)
        for k in range(PLANES):
            under[k] = -self.resting_z[k] - corner * self.resting_x[k]
        self.fall_east = (greatest(under) - self.sink) / corner
        for k in range(PLANES):
            under[k] = -self.resting_z[k] + corner * self.resting_x[k]
        self.fall_west = (greatest(under) - self.sink) / corner
        for k in range(PLANES):
            under[k] = -self.resting_z[k] - corner * self.resting_y[k]
        self.fall_north = (greatest(under) - self.sink) / corner
        for k in range(PLANES):
            under[k] = -self.resting_z[k] + corner * self.resting_y[k]
        self.fall_south = (greatest(under) - self.sink) / corner

    def find_rise(self, row: cython.Py_ssize_t, column: cython.Py_ssize_t) -> None:
        """Set the lander at a grid point over the cells that may be in its way.

        Until one rises over the limit: by how much does not matter.
        """
        cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, place=cython.Py_ssize_t)
        # What is in the way of one grid point mostly is of the next.
        i, j = self.spoiler_row - row, self.spoiler_column - column
        worst: cython.float = self.worst_rise
        if 0 <= i < 2 * self.reach and -self.half[i] <= j - self.reach < self.half[i]:
            worst = self.rise_at(row, column, i, j, worst)
        level: cython.float = self.sink + self.rounding
        aside: cython.float = max(max(self.fall_east, self.fall_west), 0.0)
        # What is not higher than this is in the way in no row.
        most: cython.float = max(max(self.fall_south, self.fall_north), aside) * self.corner + level
        low: cython.float = worst - most
        for i in range(2 * self.reach):
            if self.highest[i * POINTS + row * BLOCK + column] <= low:
                continue
            deep = self.away[i] * (self.fall_south if i < self.reach else self.fall_north) + level
            most = self.aside[i] * aside + deep
            if self.highest[i * POINTS + row * BLOCK + column] + most <= worst:
                continue
            least: cython.float = worst - most
            place = (row + i) * self.width + column
            for j in range(self.reach - self.half[i], self.reach + self.half[i]):
                height = self.top[place + j]
                if height <= least:
                    continue
                fall = self.fall_west if j < self.reach else self.fall_east
                if height + (self.away[j] * fall + deep) > worst:
                    worst = self.rise_at(row, column, i, j, worst)
                    if worst > self.high_rise:
                        break
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
