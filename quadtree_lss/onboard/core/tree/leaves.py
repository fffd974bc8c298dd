# SPDX-License-Identifier: Apache-2.0
"""The quadtree (paper III.A) as a table: a row for each leaf, and the row over each finest cell.

Finest cells are numbered in Morton order, so that every cell of every level is one run of numbers,
and a point finds its leaf without descending the tree. Division turns one row into four.
A plane is Eq. 37 with the covariance of Eq. 38.
"""

from __future__ import annotations

from typing import Any, TypeAlias

import cython
import numpy as np
from cython.cimports.libc.math import INFINITY, NAN, fabs
from cython.cimports.quadtree_lss.onboard.core.geometry.morton import encode, prefetch
from cython.cimports.quadtree_lss.onboard.core.geometry.plane import shift_origin
from cython.cimports.quadtree_lss.onboard.core.geometry.sphere import basis_at
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import INHERITED, NOTHING, OUT, SEEN
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import MEASURED as MEASURED
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Bytes, Index, Ints, Numbers
from quadtree_lss.onboard.core.geometry.morton import SPREAD
from quadtree_lss.onboard.core.tree.domain import Domain

#: A slope less certain than this, rad^2, is none. None is handed on so: strips, which keep it,
#: would lie anywhere.
NO_SLOPE = cython.declare(cython.double, 0.3**2)

#: One record of a table: a pointer to a C structure, or a record of NumPy.
Record: TypeAlias = Any

#: A leaf:
#:
#: - level, ix, iy: its place; x, y: its centre, m;
#: - known: 0 nothing, 1 points that do not tell a plane yet, 2 inherited, 3 measured;
#: - first_time, last_time: of the first and last scan in its plane, s since the first in the map;
#: - z, normal: the plane's elevation at the centre, m, and its upward unit normal;
#: - range_part, pose_part: covariance (9) of (dphi_1, dphi_2, dd), d about (x, y, z), from range
#:   noise and from pose error;
#: - points: measurements in the plane;
#: - distance_sum, exception_sum: of |orthogonal distance| (Eq. 55), m, and of exception masses
#:   (Eq. 48); noise_sum, exception_noise: what range noise alone adds to each; residuals:
#:   measurements in these sums;
#: - division_sum, square_sum, division_weight: sums of the division statistic and of the mean
#:   square residual about the scans' own fits, m^2, and of their weights;
#: - low, high: lowest and highest return, m, of those that came to rest here, or before that of
#:   those of the parent; low > high for none; greatest: |orthogonal distance| of one, m;
#: - strip: the greatest share of its width that a strip showed which told no plane of it;
#: - uneven: mean square, m^2, that a plane of its size would leave out by what those leave out that
#:   it was divided from;
#: - bias: means of what noise along the rays may turn its fits by, t t^T as xx, xy, yy, rad^2, and
#:   lift them by (`LIFT`), m, and the weight of the first (`WEIGHT`), m^2;
#: - feature: A, k, mu_x, mu_y about the centre, sigma (Eq. 51), NaN for none, and its inverse
#:   covariance (25), feature_information.
LEAF = np.dtype(
    [(name, "i4") for name in ("level", "ix", "iy", "known")]
    + [(name, "f8") for name in ("x", "y", "z", "first_time", "last_time")]
    + [("normal", "f8", 3), ("range_part", "f8", 9), ("pose_part", "f8", 9), ("points", "f8")]
    + [(f"{name}_sum", "f8") for name in ("distance", "noise", "exception")]
    + [("exception_noise", "f8")]
    + [("residuals", "f8"), ("division_sum", "f8"), ("division_weight", "f8"), ("square_sum", "f8")]
    + [("low", "f8"), ("high", "f8"), ("greatest", "f8"), ("strip", "f8"), ("uneven", "f8")]
    + [("bias", "f8", 5), ("feature", "f8", 5), ("feature_information", "f8", 25)]
)


def clear(leaf: Record) -> None:
    """Forget all that was found in a leaf but for its plane."""
    i: cython.int
    leaf.points = 0.0
    leaf.distance_sum = leaf.noise_sum = 0.0
    leaf.exception_sum = leaf.exception_noise = leaf.residuals = 0.0
    leaf.division_sum = leaf.division_weight = leaf.square_sum = 0.0
    leaf.greatest = leaf.strip = 0.0
    for i in range(5):
        leaf.bias[i] = 0.0
        leaf.feature[i] = NAN


def blank() -> NDArray[np.void]:
    """(1,) a leaf of which nothing is known, nowhere yet."""
    leaf = np.zeros(1, dtype=LEAF)
    leaf["feature"] = np.nan
    leaf["low"], leaf["high"] = np.inf, -np.inf
    return leaf


class LeafTable:
    """The leaves of a map, divided to the minimum level at the start.

    Attributes:
        rows: Records of type `LEAF`, of which the first ``count`` are leaves; a division may
            replace the array by a longer one.
        leaf_of: (4^max_level,) row of the leaf over each finest cell, by its Morton code.
        observed: (4^max_level,) of the finest cells: 0 where no point fell, 1 where one did, 2
            where one was compared with the plane of the leaf, or of that which it was divided
            from, 3 where one stood out from that.
        piled: (4^max_level, 2) of the finest cells: how far returns lie above that plane, m,
            summed up, and how many.
        hit_parts: (4^max_level,) uint16: a bit for each of the 4 x 4 parts of a finest cell, set
            where a return fell.
        count, capacity, max_cells: Leaves, rows, and how many leaves there may be.
    """

    def __init__(self, domain: Domain, max_cells: int) -> None:
        self.lie_on(domain)
        self.max_cells = max_cells
        self.max_level = domain.max_level
        self.sides = [0.0] * 32
        for level in range(domain.max_level + 1):
            self.sides[level] = domain.size / (1 << level)
        finest = 4**domain.max_level
        self.over = self.leaf_of = np.zeros(finest, dtype=np.int32)
        self.seen = self.observed = np.zeros(finest, dtype=np.uint8)
        self.pile = self.piled = np.zeros((finest, 2), dtype=np.float32)
        self.hits = self.hit_parts = np.zeros(finest, dtype=np.uint16)
        self.plant()

    def plant(self) -> None:
        """Forget all leaves and divide to the minimum level."""
        self.observed[:] = 0
        self.piled[:] = 0.0
        self.hit_parts[:] = 0
        side = 1 << self.domain.min_level
        iy, ix = np.divmod(np.arange(side * side), side)
        level = np.full(side * side, self.domain.min_level)
        self.take_up({"level": level, "ix": ix, "iy": iy})

    def take_up(self, columns: dict[str, NDArray[np.generic]]) -> None:
        """Have the leaves of these columns, which tile the domain (not checked here)."""
        row: cython.Py_ssize_t
        self.count = self.capacity = count = len(columns["level"])
        self.leaf = self.rows = np.zeros(count, dtype=LEAF).view(np.recarray)
        self.rows[:] = blank()
        for name, column in columns.items():
            self.rows[name][:count] = column
        for row in range(count):
            self._place(row, self.leaf[row].level, self.leaf[row].ix, self.leaf[row].iy)

    def lie_on(self, domain: Domain) -> None:
        """The leaves are those of this square, of the same size and levels: `take_up` follows."""
        self.domain = domain
        self.xmin, self.ymin = domain.xmin, domain.ymin

    def follow(self, east: cython.int, north: cython.int) -> None:
        """Move the square by so many coarsest cells along x and along y.

        Leaves that come to lie outside are dropped; the others keep all that they know, to the bit.
        """
        cython.declare(row=cython.Py_ssize_t, kept=cython.Py_ssize_t, new=cython.Py_ssize_t)
        cython.declare(ix=cython.int, iy=cython.int, parts=cython.int)
        least: cython.int = self.domain.min_level
        side: cython.int = 1 << least
        self.lie_on(self.domain.moved(east, north))
        observed = self.observed.copy()
        kept = 0
        for row in range(self.count):
            leaf = self.at(row)
            parts = 1 << (leaf.level - least)
            ix = leaf.ix - east * parts
            iy = leaf.iy - north * parts
            if 0 <= ix < side * parts and 0 <= iy < side * parts:
                if kept != row:
                    self.leaf[kept] = self.leaf[row]
                self._place(kept, self.at(kept).level, ix, iy)
                kept += 1
        # Each coarsest cell that was dropped had a leaf: there is room for as many.
        new = side * side - max(side - abs(east), 0) * max(side - abs(north), 0)
        self.rows[kept : kept + new] = blank()
        for iy in range(side):
            for ix in range(side):
                if not (0 <= ix + east < side and 0 <= iy + north < side):
                    self._place(kept, least, ix, iy)
                    kept += 1
        self.count = kept
        parts = 1 << (self.max_level - least)
        n, east, north = side * parts, east * parts, north * parts
        self.observed[:] = shifted(observed, n, east, north)
        self.piled[:] = shifted(self.piled, n, east, north)
        self.hit_parts[:] = shifted(self.hit_parts, n, east, north)

    def reserve(self, more: cython.Py_ssize_t) -> None:
        """Have room for so many further leaves, as far as ``max_cells`` allows."""
        wanted = min(self.count + more, self.max_cells)
        if wanted > self.capacity:
            grown = np.zeros(max(wanted, min(2 * self.capacity, self.max_cells)), dtype=LEAF)
            grown[: self.count] = self.rows[: self.count]
            self.leaf = self.rows = grown.view(np.recarray)
            self.capacity = len(grown)

    def at(self, row: cython.Py_ssize_t) -> Record:
        """A leaf, to read and to write; until the table grows."""
        return cython.address(self.leaf[row])

    def glance(self, row: cython.Py_ssize_t) -> None:
        """Prefetch the first line of a leaf: its place, and whether it is known."""
        prefetch(cython.address(self.leaf[row]))

    def expect(self, row: cython.Py_ssize_t) -> None:
        """Prefetch a leaf that will be wanted soon, but for its feature."""
        i: cython.int
        byte: cython.p_char = cython.cast(cython.p_char, cython.address(self.leaf[row]))
        for i in range(0, 448, 64):
            prefetch(byte + i)

    def side(self, level: cython.int) -> cython.double:
        """Side of a cell of a level, m."""
        return self.sides[level]

    @cython.boundscheck(False)
    def _place(
        self, row: cython.Py_ssize_t, level: cython.int, ix: cython.int, iy: cython.int
    ) -> None:
        cython.declare(code=cython.Py_ssize_t, first=cython.Py_ssize_t)
        leaf = self.at(row)
        side = self.side(level)
        leaf.level = level
        leaf.ix = ix
        leaf.iy = iy
        leaf.x = self.xmin + (ix + 0.5) * side
        leaf.y = self.ymin + (iy + 0.5) * side
        first = encode(ix, iy) << (2 * (self.max_level - level))
        for code in range(first, first + (1 << (2 * (self.max_level - level)))):
            self.over[code] = row
            if self.seen[code] == OUT:
                self.seen[code] = SEEN

    @cython.boundscheck(False)
    def _stands_out(self, level: cython.int, ix: cython.int, iy: cython.int) -> cython.bint:
        """Whether a return stood out in a cell."""
        code: cython.Py_ssize_t
        down: cython.int = 2 * (self.max_level - level)
        first: cython.Py_ssize_t = encode(ix, iy) << down
        for code in range(first, first + (1 << down)):
            if self.seen[code] == OUT:
                return True
        return False

    @cython.boundscheck(False)
    def divide(
        self, row: cython.Py_ssize_t, square: float, tilt: float, spread: float, uneven: float
    ) -> cython.bint:
        """Divide a leaf above the maximum level; its children inherit what it knows.

        An inherited plane is the parent's moved to the child's centre, and less certain: by
        ``square`` m^2 in height and ``tilt`` rad^2 in either slope, up to `NO_SLOPE`; where a
        return stood out, by the square of the greatest distance, too. They are ``uneven`` by so
        many m^2. Finest cells whose returns lay within ``spread`` (m) of it stay known. The first
        child (in Morton's order) has the parent's row, the others follow the last leaf. They keep
        what noise may have turned the parent by. False, and nothing is done, where ``max_cells``
        leaves no room; the caller has made room in the table (`reserve`).
        """
        basis = cython.declare(cython.double[6])
        cython.declare(child=cython.Py_ssize_t, at=cython.Py_ssize_t)
        parent = self.at(row)
        level: cython.int = parent.level
        ix: cython.int = 2 * parent.ix
        iy: cython.int = 2 * parent.iy
        if self.count + 3 > self.max_cells:
            return False
        basis_at(parent.normal, basis)
        quarter = 0.25 * self.side(level)
        # The first child overwrites its parent, so it is the last to be made.
        for child in range(3, -1, -1):
            at = row if child == 0 else self.count + child - 1
            self.leaf[at] = self.leaf[row]
            leaf = self.at(at)
            xx = xy = yy = 0.0
            if leaf.known >= INHERITED:
                leaf.known = INHERITED
                xx, xy, yy = leaf.bias[0], leaf.bias[1], leaf.bias[2]
                x = quarter if child & 1 else -quarter
                y = quarter if child & 2 else -quarter
                z = -(leaf.normal[0] * x + leaf.normal[1] * y) / leaf.normal[2]
                first = basis[0] * x + basis[1] * y + basis[2] * z
                second = basis[3] * x + basis[4] * y + basis[5] * z
                leaf.z += z
                # No return that is known there lay farther from the plane.
                z = quarter * (fabs(leaf.normal[0]) + fabs(leaf.normal[1])) + spread
                leaf.low = max(leaf.low, leaf.z - z / leaf.normal[2])
                leaf.high = min(leaf.high, leaf.z + z / leaf.normal[2])
                shift_origin(leaf.range_part, first, second, 1)
                shift_origin(leaf.pose_part, first, second, 1)
                leaf.range_part[0] += max(min(tilt, NO_SLOPE - leaf.range_part[0]), 0.0)
                leaf.range_part[4] += max(min(tilt, NO_SLOPE - leaf.range_part[4]), 0.0)
                leaf.range_part[8] += square
                if self._stands_out(level + 1, ix + (child & 1), iy + (child >> 1)):
                    leaf.range_part[8] += leaf.greatest * leaf.greatest
            else:
                leaf.known = NOTHING
            clear(leaf)
            leaf.bias[0], leaf.bias[1], leaf.bias[2] = xx, xy, yy
            leaf.uneven = uneven
            self._place(at, level + 1, ix + (child & 1), iy + (child >> 1))
        self.count += 3
        return True

    @cython.boundscheck(False)
    def unmark_moved(
        self, leaf: Record, rise: float, slope_x: float, slope_y: float, limit: float
    ) -> cython.bint:
        """Mark finest cells as observed only, where the leaf's plane moved too far.

        Args:
            leaf: The leaf.
            rise: By how much its plane moved up at the leaf's centre, m.
            slope_x, slope_y: By how much dz/dx and dz/dy changed.
            limit: A finest cell keeps its state where no corner moved farther, m.

        Returns:
            Whether any finest cell is still marked as part of the map.
        """
        cython.declare(i=cython.int, j=cython.int, code=cython.Py_ssize_t)
        down: cython.int = self.max_level - leaf.level
        first: cython.Py_ssize_t = encode(leaf.ix, leaf.iy) << 2 * down
        side: cython.double = self.sides[self.max_level]
        half: cython.double = 0.5 * side * (1 << down)
        corner = 0.5 * side * (fabs(slope_x) + fabs(slope_y))
        kept: cython.bint = False
        for i in range(1 << down):
            for j in range(1 << down):
                code = first + encode(j, i)
                moved = rise + slope_x * ((j + 0.5) * side - half)
                moved += slope_y * ((i + 0.5) * side - half)
                if fabs(moved) + corner <= limit:
                    kept = kept or self.seen[code] > SEEN
                    continue
                if self.seen[code] > SEEN:
                    self.seen[code] = SEEN
                self.pile[code, 0] = self.pile[code, 1] = 0.0
                self.hits[code] = 0
        return kept

    def forget(self, leaf: Record) -> None:
        """Nothing is known of a leaf, nor of the finest cells under it; seen they were."""
        clear(leaf)
        self.unmark_moved(leaf, INFINITY, 0.0, 0.0, 0.0)
        leaf.known = NOTHING
        leaf.low, leaf.high = INFINITY, -INFINITY
        leaf.z = leaf.normal[0] = leaf.normal[1] = 0.0
        leaf.normal[2] = 1.0

    def in_order(self) -> Index:
        """Rows of the leaves in Morton order: neighbours in space are near in the table.

        Where a leaf ends, the finest cells tell: they lie side by side, the leaves all over memory.
        """
        code: cython.Py_ssize_t = 0
        at: cython.Py_ssize_t = 0
        size: cython.Py_ssize_t
        finest: cython.Py_ssize_t = self.over.shape[0]
        row: cython.int
        out = np.empty(self.count, dtype=np.intp)
        self.order = out
        while code < finest:
            row = self.over[code]
            size = 1
            while code % (4 * size) == 0 and 4 * size <= finest:
                if self.over[code + 4 * size - 1] != row:
                    break
                size *= 4
            self.order[at] = row
            code += size
            at += 1
        return out


@cython.boundscheck(False)
def unfold(values: Bytes, out: Bytes) -> None:
    """Values (n^2,) of finest cells in Morton order, laid out by row and column (n, n)."""
    cython.declare(row=cython.Py_ssize_t, column=cython.Py_ssize_t)
    places = cython.declare(cython.longlong[::1], SPREAD)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            out[row, column] = values[places[column] | places[row] << 1]


def shifted(values: NDArray[Any], n: int, east: int, north: int) -> NDArray[Any]:
    """Values (n^2, ...) of finest cells in Morton order, of the square that lies so many cells east
    and north; 0 where that is new."""
    out = np.zeros_like(values)
    x = np.arange(max(0, -east), min(n, n - east))
    y = np.arange(max(0, -north), min(n, n - north))[:, None]
    at = SPREAD[x + east] | SPREAD[y + north] << 1
    out[SPREAD[x] | SPREAD[y] << 1] = values[at]
    return out


@cython.boundscheck(False)
def leaf_raster(level: Bytes, ix: Numbers, iy: Numbers, out: Ints) -> None:
    """Which of the cells (level, ix, iy), each (M,), covers each finest cell (n, n) [iy, ix]."""
    cython.declare(i=cython.Py_ssize_t, row=cython.Py_ssize_t, column=cython.Py_ssize_t)
    cython.declare(side=cython.Py_ssize_t)
    for i in range(len(level)):
        side = len(out) >> level[i]
        for row in range(iy[i] * side, (iy[i] + 1) * side):
            for column in range(ix[i] * side, (ix[i] + 1) * side):
                out[row, column] = i
