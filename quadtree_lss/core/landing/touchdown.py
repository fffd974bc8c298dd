# SPDX-License-Identifier: Apache-2.0
"""Touchdown check on the estimated map: the lander's four pads set down on the leaf planes.

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
"""

from __future__ import annotations

import cython
import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import LssConfig
from quadtree_lss.core.geometry import feature
from quadtree_lss.core.landing.lattice import disc
from quadtree_lss.core.landing.raster import TerrainRaster
from quadtree_lss.core.tree.domain import Domain

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]
Marks = NDArray[np.uint8]

if not cython.compiled:  # otherwise from the .pxd
    from math import fabs, sqrt

    BLOCK = 8
    UNKNOWN, FAILS = -1, 1
    FAR = 1e9
#: Bounds settle nothing by less than single precision can err, m.
ROUNDING = 1e-4
#: Where a resting plane may sink below the lowest pad, as a share of the pads' spread.
SAG = 0.5 * (2.0**0.5 - 1.0)
SHAPE = feature.SHAPE


class TouchdownCheck:
    """Checks maps of a growing terrain; judges again only the blocks whose ground changed.

    The verdict on a block depends on the cells that its landers can meet alone, so where none of
    them changed it is the one of before, bit for bit.
    """

    def __init__(self, config: LssConfig) -> None:
        self.config = config
        self._domain: Domain | None = None
        self._layers: tuple[Array, ...] = ()

    def unsafe(self, raster: TerrainRaster, candidates: Mask) -> Mask:
        """Grid points (n + 1, n + 1) at which some heading fails; False where not a candidate.

        Args:
            raster: The map on its finest cells.
            candidates: (n + 1, n + 1) points to check; their lander circle lies inside the domain.
        """
        layers = raster.elevation, raster.slope_x, raster.slope_y, raster.subscale
        if raster.domain != self._domain:
            self._domain, self._layers = raster.domain, ()
            self._lander = Lander(self.config, raster.domain)
            self._verdict = np.full(candidates.shape, UNKNOWN, dtype=np.int8)
        changed = np.zeros(raster.leaf.shape, dtype=np.bool_)
        for layer, before in zip(layers, self._layers, strict=False):
            changed |= layer != before
        self._layers = layers
        self._lander.stand_on(*layers)
        due, other = candidates.view(np.uint8), changed.view(np.uint8)
        for block in range(self._lander.blocks):  # between them a signal can end it
            self._lander.judge(due, other, self._verdict, block)
        return np.asarray(candidates & (self._verdict == FAILS))


@cython.boundscheck(False)
class Lander:
    """A lander, and the ground about one block of grid points at a time.

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
        half: (width + BLOCK,) half width of the disc of cells under the lander in each row of the
            window, BLOCK rows to the south of it the first, in cells.
        away: (width + BLOCK,) of the centres of those rows from a grid point, and of columns, m.
        top, pad, slope_x, slope_y: (width^2,) window over the block's plane: highest ground of
            each cell, height of a pad at its centre, slopes.
        stand: (4 yaws, BLOCK^2) heights of the pads at each grid point, over the plane, m.
        floor: (BLOCK^2,) below every resting plane of a grid point, over the plane, m.
        spread: (BLOCK^2,) of the pads' heights, m.
        roof: (BLOCK^2,) highest ground under the lander, over the plane, m.
        high, height: Row and column in the window of the cells, ``highs`` of them, that may be in
            the way of some grid point, and their highest ground over the plane, m.
        begin: (width + 1,) the first of them in each row.
        near: East and north of the grid point at hand and height over the plane of those,
            ``nears`` of them, that may be in its way, m.
        plane_x, plane_y: Slopes of the block's plane.
    """

    def __init__(self, config: LssConfig, domain: Domain) -> None:
        side = domain.finest_size
        under = disc(0.5 * config.vehicle_diameter, side)
        self.side, self.radius = side, 0.5 * config.vehicle_diameter
        self.pad_radius, self.limit = config.pad_radius, config.touchdown_roughness
        self.steepest = float(np.tan(np.radians(config.touchdown_slope_deg)))
        self.yaws = config.touchdown_yaws
        self.reach = max(int(np.floor(self.radius / side)) + 1, under.reach)
        self.width = BLOCK - 1 + 2 * self.reach
        self.offset = (np.arange(self.width) - 0.5 * (self.width - 1)) * side
        self.blocks = domain.finest_count // BLOCK + 1
        around = self.blocks * BLOCK - 1 + 2 * self.reach
        self.ground = np.full((4, around, around), np.nan)
        # Cells beyond the circle may stand under the floor: then every one is compared.
        self.bounded = float(np.hypot(under.x, under.y).max()) <= self.radius
        yaw = np.arange(self.yaws) * (0.5 * np.pi / self.yaws)
        c, s = np.cos(yaw), np.sin(yaw)
        self.cos, self.sin = c / self.radius, s / self.radius
        x = self.radius * np.stack([c, -s, -c, s], axis=1).ravel()
        y = self.radius * np.stack([s, c, -s, -c], axis=1).ravel()
        column, row = np.floor(x / side).astype(np.intp), np.floor(y / side).astype(np.intp)
        self.pad_place = row * self.width + column
        self.pad_x = (x - (column + 0.5) * side).astype(np.float32)
        self.pad_y = (y - (row + 0.5) * side).astype(np.float32)
        half = np.zeros(self.width + BLOCK, dtype=np.intp)
        np.maximum.at(half, under.row + self.reach + BLOCK, under.column + 1)
        self.half = half
        across = np.arange(self.width + BLOCK) - self.reach - BLOCK + 0.5
        self.away = (across * side).astype(np.float32)
        self.begin = np.zeros(self.width + 1, dtype=np.intp)
        self.top, self.pad, self.slope_x, self.slope_y = np.zeros(
            (4, self.width**2), dtype=np.float32
        )
        self.run = np.zeros(self.width * BLOCK, dtype=np.float32)
        self.stand = np.zeros((4 * self.yaws, BLOCK**2), dtype=np.float32)
        self.floor, self.spread, self.roof = np.zeros((3, BLOCK**2), dtype=np.float32)
        self.high = np.zeros((2, self.width**2), dtype=np.intp)
        self.height = np.zeros(self.width**2, dtype=np.float32)
        self.near = np.zeros((3, self.width**2), dtype=np.float32)
        self.highs = self.nears = self.spoiler = self.heading = 0
        self.which = np.zeros(self.width**2, dtype=np.intp)
        self.plane_x = self.plane_y = 0.0

    def stand_on(self, elevation: Array, slope_x: Array, slope_y: Array, subscale: Array) -> None:
        """Take the ground of a map, (n, n) each: height, slopes and features of finest cells."""
        i: cython.Py_ssize_t
        k: cython.Py_ssize_t
        r: cython.Py_ssize_t
        c: cython.Py_ssize_t
        n: cython.Py_ssize_t = elevation.shape[0]
        first: cython.Py_ssize_t = self.reach
        after: cython.Py_ssize_t = self.reach + n
        # In variables: the compiler takes two at a time of what cannot change under its hands.
        half, pad, shape = 0.5 * self.side, self.pad_radius, 1.0 * SHAPE
        with cython.nogil:
            for i in range(self.ground.shape[1]):
                r = min(max(i - first, 0), n - 1)
                for c in range(n):
                    x, y = slope_x[r, c], slope_y[r, c]
                    self.ground[0, i, first + c] = elevation[r, c] + pad * sqrt(x * x + y * y)
                for c in range(n):
                    rise = half * (fabs(slope_x[r, c]) + fabs(slope_y[r, c]))
                    self.ground[3, i, first + c] = elevation[r, c] + rise + shape * subscale[r, c]
                for c in range(n):
                    self.ground[1, i, first + c] = slope_x[r, c]
                for c in range(n):
                    self.ground[2, i, first + c] = slope_y[r, c]
                for k in range(4):
                    self.ground[k, i, :first] = self.ground[k, i, first]
                    self.ground[k, i, after:] = self.ground[k, i, after - 1]

    def judge(
        self, due: Marks, changed: Marks, verdict: NDArray[np.int8], block: cython.Py_ssize_t
    ) -> None:
        """Bring the verdict on a row of blocks up to date after ``stand_on``.

        Args:
            due: (n + 1, n + 1) points that need one.
            changed: (n, n) cells whose ground is not that of the map before.
            verdict: (n + 1, n + 1) ``UNKNOWN``, 0 if it stands, or ``FAILS``, changed in place.
            block: Number of the row, from the south.
        """
        i: cython.Py_ssize_t
        j: cython.Py_ssize_t
        k: cython.Py_ssize_t
        other: cython.bint
        n: cython.Py_ssize_t = changed.shape[0]
        first: cython.Py_ssize_t = max(block * BLOCK - self.reach, 0)
        after: cython.Py_ssize_t = min(block * BLOCK - self.reach + self.width, n)
        columns = cython.declare(cython.uchar[::1], np.zeros(n, dtype=np.uint8))
        with cython.nogil:
            for i in range(first, after):
                for j in range(n):
                    columns[j] |= changed[i, j]
            for j in range(self.blocks):
                other = False
                k = j * BLOCK - self.reach
                for i in range(max(k, 0), min(k + self.width, n)):
                    other |= columns[i]
                self.judge_block(due, other, verdict, block * BLOCK, j * BLOCK)

    def judge_block(
        self,
        due: Marks,
        forget: cython.bint,
        verdict: NDArray[np.int8],
        row: cython.Py_ssize_t,
        column: cython.Py_ssize_t,
    ) -> None:
        """``judge`` for the grid points of the block that begins at one."""
        r: cython.Py_ssize_t
        c: cython.Py_ssize_t
        loaded: cython.bint = False
        for r in range(row, min(row + BLOCK, due.shape[0])):
            for c in range(column, min(column + BLOCK, due.shape[1])):
                if forget:
                    verdict[r, c] = UNKNOWN
                if not due[r, c] or verdict[r, c] != UNKNOWN:
                    continue
                if not loaded:
                    self.load(row, column)
                    self.set_down()
                    self.cover()
                    loaded = True
                verdict[r, c] = self.fails(r - row, c - column)

    def load(self, row: cython.Py_ssize_t, column: cython.Py_ssize_t) -> None:
        """Take the ground of the window that begins at a cell.

        The plane is one of least squares, through every other cell; any would do.
        """
        i: cython.Py_ssize_t
        j: cython.Py_ssize_t
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
        self.plane_x, self.plane_y = slope_x, slope_y

    def set_down(self) -> None:
        """Heights of the pads about every grid point of the block, and their bounds."""
        k: cython.Py_ssize_t
        i: cython.Py_ssize_t
        j: cython.Py_ssize_t
        here: cython.Py_ssize_t
        place: cython.Py_ssize_t
        for k in range(4 * self.yaws):
            x, y = self.pad_x[k], self.pad_y[k]
            for i in range(BLOCK):
                here = i * BLOCK
                place = (self.reach + i) * self.width + self.reach + self.pad_place[k]
                for j in range(BLOCK):
                    z = self.pad[place + j] + self.slope_x[place + j] * x
                    self.stand[k, here + j] = z + self.slope_y[place + j] * y
        self.floor[:] = self.stand[0]
        self.spread[:] = self.stand[0]
        for k in range(1, 4 * self.yaws):
            for i in range(BLOCK * BLOCK):
                z = self.stand[k, i]
                self.floor[i] = z if z < self.floor[i] else self.floor[i]
                self.spread[i] = z if z > self.spread[i] else self.spread[i]
        for i in range(BLOCK * BLOCK):
            self.spread[i] -= self.floor[i]
            self.floor[i] -= SAG * self.spread[i] + ROUNDING if self.bounded else FAR

    def cover(self) -> None:
        """Highest ground under the lander at every grid point, and the cells that matter.

        A disc is a stack of centred runs of cells.
        """
        i: cython.Py_ssize_t
        j: cython.Py_ssize_t
        k: cython.Py_ssize_t
        half: cython.Py_ssize_t
        place: cython.Py_ssize_t
        highs: cython.Py_ssize_t = 0
        self.run[:] = -FAR
        self.roof[:] = -FAR
        for half in range(1, self.reach + 1):
            for i in range(self.width):
                place = i * self.width + self.reach
                k = i * BLOCK
                for j in range(BLOCK):
                    west, east = self.top[place - half + j], self.top[place + half - 1 + j]
                    z = west if west > east else east
                    self.run[k + j] = z if z > self.run[k + j] else self.run[k + j]
            for i in range(2 * self.reach):
                if self.half[i + BLOCK] == half:
                    for k in range(BLOCK * BLOCK):
                        z = self.run[i * BLOCK + k]
                        self.roof[k] = z if z > self.roof[k] else self.roof[k]
        lowest = 1.0 * FAR
        for k in range(BLOCK * BLOCK):
            if self.roof[k] > self.floor[k] + self.limit and self.floor[k] < lowest:
                lowest = self.floor[k]
        self.highs = self.spoiler = 0
        if lowest == FAR:
            return
        lowest += self.limit
        for i in range(self.width):
            self.begin[i] = highs
            for j in range(self.width):
                # Listed, and kept if it is higher: no branch for the processor to foresee.
                z = self.top[i * self.width + j]
                self.high[0, highs], self.high[1, highs], self.height[highs] = i, j, z
                highs += z > lowest
        self.begin[self.width] = self.highs = highs

    def fails(self, row: cython.Py_ssize_t, column: cython.Py_ssize_t) -> cython.bint:
        """Whether the lander at a grid point of the block fails at some heading."""
        place: cython.Py_ssize_t = row * BLOCK + column
        last: cython.Py_ssize_t
        lowest = self.floor[place] + self.limit
        tilt = sqrt(self.plane_x**2 + self.plane_y**2) + self.spread[place] / self.radius
        steep: cython.bint = tilt > self.steepest - ROUNDING
        self.nears = 0
        if self.roof[place] > lowest:
            # What spoilt the last grid point mostly spoils this one.
            self.gather(row, column, lowest, self.spoiler, self.spoiler + 1)
            if self.nears and self.fails_somewhere(place):
                return True
            self.nears = 0
            last = self.begin[row + 2 * self.reach]
            self.gather(row, column, lowest, self.begin[row], last)
        return (steep or self.nears > 0) and self.fails_somewhere(place)

    def fails_somewhere(self, place: cython.Py_ssize_t) -> cython.bint:
        """Whether some heading fails by its slope or by one of the cells that are listed."""
        i: cython.Py_ssize_t
        k: cython.Py_ssize_t
        for i in range(self.yaws):
            k = (self.heading + i) % self.yaws
            east, north = self.stand[4 * k, place], self.stand[4 * k + 1, place]
            west, south = self.stand[4 * k + 2, place], self.stand[4 * k + 3, place]
            if east + west >= north + south:
                centre, own = 0.5 * (east + west), 0.5 * (east - west)
                bad = self.rests_badly(k, centre, own, north - centre)
                bad = bad or self.rests_badly(k, centre, own, centre - south)
            else:
                centre, own = 0.5 * (north + south), 0.5 * (north - south)
                bad = self.rests_badly(k, centre, east - centre, own)
                bad = bad or self.rests_badly(k, centre, centre - west, own)
            if bad:
                self.heading = k
                return True
        return False

    def gather(
        self,
        row: cython.Py_ssize_t,
        column: cython.Py_ssize_t,
        above: cython.double,
        first: cython.Py_ssize_t,
        last: cython.Py_ssize_t,
    ) -> None:
        """List the cells under the lander at a grid point that are higher than ``above``."""
        k: cython.Py_ssize_t
        j: cython.Py_ssize_t
        i: cython.Py_ssize_t
        half: cython.Py_ssize_t
        nears: cython.Py_ssize_t = 0
        middle: cython.Py_ssize_t = self.reach + BLOCK
        for k in range(first, last):
            i, j = self.high[0, k] - row + BLOCK, self.high[1, k] - column + BLOCK
            half = self.half[i]
            # Without a branch, which no processor could foresee.
            self.near[0, nears], self.near[1, nears] = self.away[j], self.away[i]
            self.near[2, nears] = self.height[k]
            self.which[nears] = k
            nears += (self.height[k] > above) & (middle - half <= j) & (j < middle + half)
        self.nears = nears

    def rests_badly(
        self,
        heading: cython.Py_ssize_t,
        centre: cython.double,
        along: cython.double,
        across: cython.double,
    ) -> cython.bint:
        """Whether a resting plane is too steep, or ground rises too high above it.

        Args:
            heading: Its number.
            centre: Height of the plane at the grid point over the block's plane, m.
            along, across: How much it rises in the heading and across it over a radius, m.
        """
        k: cython.Py_ssize_t
        above: cython.int
        z: cython.float
        rise_x: cython.float
        rise_y: cython.float
        highest: cython.float
        x = along * self.cos[heading] - across * self.sin[heading]
        y = along * self.sin[heading] + across * self.cos[heading]
        steep_x, steep_y = x + self.plane_x, y + self.plane_y
        if steep_x * steep_x + steep_y * steep_y > self.steepest * self.steepest:
            return True
        rise_x, rise_y, highest = x, y, centre + self.limit
        above = 0
        for k in range(self.nears):
            z = self.near[2, k] - rise_x * self.near[0, k]
            above += z - rise_y * self.near[1, k] > highest
        if above == 0:
            return False
        for k in range(self.nears):
            z = self.near[2, k] - rise_x * self.near[0, k]
            if z - rise_y * self.near[1, k] > highest:
                self.spoiler = self.which[k]
                break
        return True
