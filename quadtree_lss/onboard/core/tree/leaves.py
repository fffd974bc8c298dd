# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False
"""The quadtree (paper III.A) as a table: a row for each leaf, and the row over each finest cell.

Finest cells are numbered in Morton order, so that every cell of every level is one run of numbers,
and a point finds its leaf without descending the tree. Division turns one row into four.
A plane is Eq. 37 with the covariance of Eq. 38.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import cython
import numpy as np
from cython.cimports.libc.math import INFINITY, NAN, fabs
from cython.cimports.quadtree_lss.onboard.core.geometry.morton import encode, prefetch
from cython.cimports.quadtree_lss.onboard.core.geometry.plane import shift_origin
from cython.cimports.quadtree_lss.onboard.core.geometry.sphere import basis_at
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import ESTIMATED as ESTIMATED
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import EXPLAINED as EXPLAINED
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import INHERITED, UNEXPLAINED, UNKNOWN
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import OBSERVED as OBSERVED
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Bytes, Index, Ints, Mask, Numbers
from quadtree_lss.onboard.core.geometry.morton import SPREAD
from quadtree_lss.onboard.core.tree.domain import Domain, carried

#: Greatest slope variance of an inherited plane, rad^2; with a larger one, strips that keep the
#: slope would have arbitrary planes.
NO_SLOPE = cython.declare(cython.double, 0.3**2)

#: A record of a table: a pointer to a C structure, or a NumPy record.
Record: TypeAlias = Any

#: A leaf:
#:
#: - level, ix, iy: its place; x, y: its centre, m;
#: - state: `UNKNOWN`, `INCOMPLETE` (its points do not determine a plane), `INHERITED` or
#:   `ESTIMATED`;
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
#: - low, high: lowest and highest return, m, at first those of the parent; low > high for none;
#:   greatest: |orthogonal distance| of a return, m;
#: - strip_width: greatest share of its width that a view without a plane covered;
#: - parent_misfit: mean square misfit that its parent's predicts, m^2;
#: - bias: mean turn of its fits by noise along the rays, t t^T as xx, xy, yy, rad^2, their lift
#:   (`LIFT`), m, and the weight of the turn (`WEIGHT`), m^2;
#: - feature: A, k, mu_x, mu_y about the centre, sigma (Eq. 51), NaN for none, and its inverse
#:   covariance (25), feature_information.
NUMBERS = "points distance_sum noise_sum exception_sum exception_noise residuals division_sum"
NUMBERS += " division_weight square_sum low high greatest strip_width parent_misfit"
LEAF = np.dtype(
    [(name, "i4") for name in ("level", "ix", "iy", "state")]
    + [(name, "f8") for name in ("x", "y", "z", "first_time", "last_time")]
    + [("normal", "f8", 3), ("range_part", "f8", 9), ("pose_part", "f8", 9)]
    + [(name, "f8") for name in NUMBERS.split()]
    + [("bias", "f8", 5), ("feature", "f8", 5), ("feature_information", "f8", 25)]
)


def reset_statistics(leaf: Record) -> None:
    """Clear everything of a leaf except its place and plane."""
    i: cython.int
    leaf.points = 0.0
    leaf.distance_sum = leaf.noise_sum = 0.0
    leaf.exception_sum = leaf.exception_noise = leaf.residuals = 0.0
    leaf.division_sum = leaf.division_weight = leaf.square_sum = 0.0
    leaf.greatest = leaf.strip_width = 0.0
    for i in range(5):
        leaf.bias[i] = 0.0
        leaf.feature[i] = NAN


def blank_leaves(level: int, ix: Index, iy: Index) -> NDArray[np.void]:
    """Return leaves (M,) of a level without information."""
    leaves = np.zeros(len(ix), dtype=LEAF)
    leaves["level"], leaves["ix"], leaves["iy"] = level, ix, iy
    leaves["feature"] = np.nan
    leaves["low"], leaves["high"] = np.inf, -np.inf
    return leaves


class LeafTable:
    """Leaves of a map, initially those of the minimum level.

    Attributes:
        rows: Records of type `LEAF`; the first ``count`` are leaves. A division may replace the
            array by a longer one.
        leaf_of: (4^max_level,) row of the leaf over each finest cell, by its Morton code.
        observed: (4^max_level,) states of the finest cells: 0 not observed, 1 observed, 2 explained
            by the plane of the leaf (or of the one it was divided from), 3 unexplained.
        piled: (4^max_level, 2) sum of the heights of returns over that plane, m, and their number.
        hit_parts: (4^max_level,) uint16: a bit for each of the 4 x 4 parts of a finest cell, set
            where a return fell.
        count, capacity, max_cells: Number of leaves, rows, and greatest number of leaves.
    """

    def __init__(self, domain: Domain, max_cells: int) -> None:
        self.set_domain(domain)
        self.max_cells = max_cells
        self.max_level = domain.max_level
        self.sides = [domain.size / (1 << level) for level in range(32)]
        finest = 4**domain.max_level
        self.over = self.leaf_of = np.zeros(finest, dtype=np.int32)
        self.seen = self.observed = np.zeros(finest, dtype=np.uint8)
        self.pile = self.piled = np.zeros((finest, 2), dtype=np.float32)
        self.hits = self.hit_parts = np.zeros(finest, dtype=np.uint16)
        self.reset()

    def reset(self) -> None:
        """Remove all leaves and divide to the minimum level."""
        self.observed[:] = 0
        self.piled[:] = 0.0
        self.hit_parts[:] = 0
        side = 1 << self.domain.min_level
        iy, ix = np.divmod(np.arange(side * side), side)
        self.set_leaves(blank_leaves(self.domain.min_level, ix, iy))

    def set_leaves(self, leaves: NDArray[np.void]) -> None:
        """Set the leaves, which must tile the domain (not checked here)."""
        row: cython.Py_ssize_t
        self.count = self.capacity = len(leaves)
        self.leaf = self.rows = leaves.copy().view(np.recarray)
        for row in range(self.count):
            self._place(row, self.leaf[row].level, self.leaf[row].ix, self.leaf[row].iy)

    def set_domain(self, domain: Domain) -> None:
        """Set the square, of the same size and levels; call `set_leaves` next."""
        self.domain = domain
        self.xmin, self.ymin = domain.xmin, domain.ymin

    def follow(self, east: int, north: int) -> None:
        """Move the square by ``east``, ``north`` coarsest cells.

        Leaves that are then outside are dropped; the others keep all values to the bit.
        """
        least = self.domain.min_level
        side = 1 << least
        leaves, observed = np.array(self.rows[: self.count], dtype=LEAF), self.observed.copy()
        parts = 1 << (leaves["level"] - least)
        leaves["ix"] -= east * parts
        leaves["iy"] -= north * parts
        inside = _inside(leaves["ix"], leaves["iy"], side * parts)
        iy, ix = np.indices((side, side))
        new = ~_inside(ix + east, iy + north, side)
        self.set_domain(self.domain.moved(east, north))
        self.set_leaves(np.concatenate([leaves[inside], blank_leaves(least, ix[new], iy[new])]))
        finest = 1 << (self.max_level - least)
        code = to_grid(np.arange(len(observed)))
        source = carried(code, east * finest, north * finest, -1)
        self.observed[:] = observed
        for array in (self.observed, self.piled, self.hit_parts):
            moved = array[source]
            moved[source < 0] = 0
            array[code] = moved

    def reserve(self, more: cython.Py_ssize_t) -> None:
        """Grow the table for ``more`` further leaves, as far as ``max_cells`` allows."""
        wanted = min(self.count + more, self.max_cells)
        if wanted > self.capacity:
            grown = np.zeros(max(wanted, min(2 * self.capacity, self.max_cells)), dtype=LEAF)
            grown[: self.count] = self.rows[: self.count]
            self.leaf = self.rows = grown.view(np.recarray)
            self.capacity = len(grown)

    def at(self, row: cython.Py_ssize_t) -> Record:
        """Return a pointer to a leaf, valid until the table grows."""
        return cython.address(self.leaf[row])

    def prefetch_header(self, row: cython.Py_ssize_t) -> None:
        """Prefetch the first cache line of a leaf: its place and state."""
        prefetch(cython.address(self.leaf[row]))

    def prefetch_leaf(self, row: cython.Py_ssize_t) -> None:
        """Prefetch a leaf except its feature."""
        i: cython.int
        byte: cython.p_char = cython.cast(cython.p_char, cython.address(self.leaf[row]))
        for i in range(0, 448, 64):
            prefetch(byte + i)

    def _place(
        self, row: cython.Py_ssize_t, level: cython.int, ix: cython.int, iy: cython.int
    ) -> None:
        cython.declare(code=cython.Py_ssize_t, first=cython.Py_ssize_t)
        leaf = self.at(row)
        side = self.sides[level]
        leaf.level = level
        leaf.ix = ix
        leaf.iy = iy
        leaf.x = self.xmin + (ix + 0.5) * side
        leaf.y = self.ymin + (iy + 0.5) * side
        first = encode(ix, iy) << (2 * (self.max_level - level))
        for code in range(first, first + (1 << (2 * (self.max_level - level)))):
            self.over[code] = row
            if self.seen[code] == UNEXPLAINED:
                self.seen[code] = OBSERVED

    def _stands_out(self, level: cython.int, ix: cython.int, iy: cython.int) -> cython.bint:
        """Return whether a cell has an unexplained finest cell."""
        code: cython.Py_ssize_t
        down: cython.int = 2 * (self.max_level - level)
        first: cython.Py_ssize_t = encode(ix, iy) << down
        for code in range(first, first + (1 << down)):
            if self.seen[code] == UNEXPLAINED:
                return True
        return False

    def divide(
        self, row: cython.Py_ssize_t, square: float, tilt: float, spread: float, uneven: float
    ) -> cython.bint:
        """Divide a leaf above the maximum level, for which rows are reserved; return False, and do
        nothing, beyond ``max_cells``.

        The children inherit the plane and its bias, with a variance greater by ``square``, m^2, in
        height and ``tilt``, rad^2, in either slope, up to `NO_SLOPE`; where a return is
        unexplained, also by the square of the greatest distance. ``uneven``: the children's
        ``parent_misfit``, m^2. ``spread``: greatest distance of explained returns, m. The first
        child has the parent's row, the others follow the last leaf.
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
        quarter = 0.25 * self.sides[level]
        # The first child overwrites its parent, so it is made last.
        for child in range(3, -1, -1):
            at = row if child == 0 else self.count + child - 1
            self.leaf[at] = self.leaf[row]
            leaf = self.at(at)
            xx = xy = yy = 0.0
            if leaf.state >= INHERITED:
                leaf.state = INHERITED
                xx, xy, yy = leaf.bias[0], leaf.bias[1], leaf.bias[2]
                x = quarter if child & 1 else -quarter
                y = quarter if child & 2 else -quarter
                z = -(leaf.normal[0] * x + leaf.normal[1] * y) / leaf.normal[2]
                first = basis[0] * x + basis[1] * y + basis[2] * z
                second = basis[3] * x + basis[4] * y + basis[5] * z
                leaf.z += z
                # Explained returns were no farther from the plane.
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
                leaf.state = UNKNOWN
            reset_statistics(leaf)
            leaf.bias[0], leaf.bias[1], leaf.bias[2] = xx, xy, yy
            leaf.parent_misfit = uneven
            self._place(at, level + 1, ix + (child & 1), iy + (child >> 1))
        self.count += 3
        return True

    def unmark_moved(
        self, leaf: Record, rise: float, slope_x: float, slope_y: float, limit: float
    ) -> cython.bint:
        """Mark finest cells as observed only where a corner moved by more than ``limit``, m; return
        whether any is still part of the map. The leaf's plane moved by ``rise``, m, at its centre,
        and by ``slope_x``, ``slope_y`` in dz/dx and dz/dy."""
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
                    kept = kept or self.seen[code] > OBSERVED
                    continue
                if self.seen[code] > OBSERVED:
                    self.seen[code] = OBSERVED
                self.pile[code, 0] = self.pile[code, 1] = 0.0
                self.hits[code] = 0
        return kept

    def reset_leaf(self, leaf: Record) -> None:
        """Remove all information of a leaf; its finest cells stay observed."""
        reset_statistics(leaf)
        self.unmark_moved(leaf, INFINITY, 0.0, 0.0, 0.0)
        leaf.state = UNKNOWN
        leaf.low, leaf.high = INFINITY, -INFINITY
        leaf.z = leaf.normal[0] = leaf.normal[1] = 0.0
        leaf.normal[2] = 1.0

    def rows_in_morton_order(self) -> Index:
        """Return the rows of the leaves in Morton order, so that neighbours are close in memory."""
        cython.declare(code=cython.Py_ssize_t, i=cython.Py_ssize_t)
        out = np.empty(self.count, dtype=np.intp)
        order = cython.declare(cython.Py_ssize_t[::1], out)
        code = 0
        for i in range(self.count):
            order[i] = self.over[code]
            code += 1 << 2 * (self.max_level - self.leaf[order[i]].level)
        return out


def _inside(ix: Index, iy: Index, side: int | Index) -> Mask:
    inside: Mask = (ix >= 0) & (ix < side) & (iy >= 0) & (iy < side)
    return inside


def to_grid(values: NDArray[Any]) -> NDArray[Any]:
    """Return values (n^2,) of finest cells in Morton order as (n, n) [iy, ix]."""
    places = SPREAD[: math.isqrt(len(values))]
    return np.take(values, places | places[:, None] << 1)


def leaf_raster(level: Bytes, ix: Numbers, iy: Numbers, out: Ints) -> None:
    """Write to ``out`` (n, n) [iy, ix] which of the cells (level, ix, iy), each (M,), covers each
    finest cell."""
    cython.declare(i=cython.Py_ssize_t, row=cython.Py_ssize_t, column=cython.Py_ssize_t)
    cython.declare(side=cython.Py_ssize_t)
    for i in range(len(level)):
        side = len(out) >> level[i]
        for row in range(iy[i] * side, (iy[i] + 1) * side):
            for column in range(ix[i] * side, (ix[i] + 1) * side):
                out[row, column] = i
