# SPDX-License-Identifier: Apache-2.0
"""What one scan does to the leaves: fit, fuse, judge, divide, come to rest (paper IV)."""

from __future__ import annotations

import cython
import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.mapping.features import Heights
from quadtree_lss.core.mapping.measure import RUN, Rules
from quadtree_lss.core.sensing.register import RegisteredScan
from quadtree_lss.core.tree.leaves import LeafTable

if not cython.compiled:
    from math import erfc, exp, fabs, sqrt

    from quadtree_lss.core.geometry.plane import fuse
    from quadtree_lss.core.geometry.sphere import basis_at
    from quadtree_lss.core.mapping.division import (
        asks,
        hides_rock,
        mahalanobis_factor,
        mean_distance,
    )
    from quadtree_lss.core.mapping.features import update_feature
    from quadtree_lss.core.mapping.measure import measure

    NOTHING, HINTS, INHERITED, MEASURED = range(4)
    fmax, fmin = max, min

Array = NDArray[np.float64]

#: E[chi_1] = sqrt(2 / pi).
MEAN_CHI_1 = cython.declare(cython.double, 0.7978845608028654)
#: A point stands out of curved ground if it is this many root mean square residuals above.
OUTSTANDING = cython.declare(cython.double, 4.0)
#: A slope less certain than this (rad, one sigma) is none.
MAX_SLOPE_SIGMA = cython.declare(cython.double, 0.3)
#: Before anything is known, ground is level but for this (rad, one sigma) ...
LEVEL_SIGMA = cython.declare(cython.double, 0.5)
#: ... and this high or low, m.
HEIGHT_SIGMA = cython.declare(cython.double, 1e3)
#: Points of a scan in a cell that tell the range noise.
NOISE_POINTS = cython.declare(cython.double, 8.0)


def _above(deviations: float) -> cython.double:
    """P(N(0, 1) > deviations)."""
    return 0.5 * erfc(0.7071067811865476 * deviations)


class ScanUpdate:
    """One scan on its way through the leaves.

    Points lie about the lidar, in Morton order, so that those of a cell of any level are one run.

    Attributes:
        cells: Leaves that the scan touches.
        touched: (cells,) their rows; fits: (cells,) records of type `RUN`.
        divisions, refused: Cells divided, and divisions for which there was no room.
        ratio: (2, R) of the cells in which points came to rest and that tell the range noise:
            observed over configured deviation, and points.
    """

    def __init__(self, table: LeafTable, rules: Rules, scan: RegisteredScan, now: float) -> None:
        count = len(scan.key)
        self.table = table
        self.rules = rules
        self.points = scan.points
        self.key = scan.key
        self.origin = scan.origin
        self.x, self.y, self.z = scan.origin.tolist()
        self.sigma = scan.pose.covariance
        self.aligned = False
        self.now = now
        self.residual = np.empty(count)
        self.heights = Heights(min(count, 1024))
        self.divisions = self.refused = self.rested = 0
        self._gather()

    def _gather(self) -> None:
        """The runs of points that share a leaf."""
        i: cython.Py_ssize_t
        cells: cython.Py_ssize_t = 0
        count: cython.Py_ssize_t = len(self.key)
        last: cython.Py_ssize_t = -1
        begins = np.empty(count + 1, dtype=np.intp)
        rows = np.empty(count, dtype=np.intp)
        self.begins, self.rows = begins, rows
        for i in range(count):
            self.table.seen[self.key[i]] = 1
            if self.table.over[self.key[i]] != last:
                last = self.table.over[self.key[i]]
                self.begins[cells] = i
                self.rows[cells] = last
                cells += 1
        self.begins[cells] = count
        self.cells = cells
        self.touched = rows[:cells]
        self.fits = np.empty(cells + self.table.max_level + 1, dtype=RUN).view(np.recarray)
        self.runs = self.fits

    def fit(self) -> None:
        """Fit every touched leaf."""
        i: cython.Py_ssize_t
        with cython.nogil:
            for i in range(self.cells):
                self._measure(self.rows[i], self.begins[i], self.begins[i + 1], i)

    def compare(self) -> Array:
        """The scan and the map in the M measured leaves that it touches, (6, M).

        The scan's height over the map, m, variance of that but for pose error, variance of the
        scan's height and of the map's from pose error, m^2, first and last time in the map, s.
        """
        i: cython.Py_ssize_t
        row: cython.Py_ssize_t
        found: cython.Py_ssize_t = 0
        leaf = self.table.leaf
        out = np.empty((6, self.cells))
        self.columns = out
        for i in range(self.cells):
            row = self.rows[i]
            if leaf[row].known == MEASURED:
                square = leaf[row].normal[2] * leaf[row].normal[2]
                own = self.runs[i].range_part[8] + leaf[row].range_part[8]
                misfit = leaf[row].square_sum / fmax(leaf[row].division_weight, 1.0)
                self.columns[0, found] = self.runs[i].z + self.z - leaf[row].z
                self.columns[1, found] = own / square + misfit
                self.columns[2, found] = self.runs[i].pose_part[8] / square
                self.columns[3, found] = leaf[row].pose_part[8] / square
                self.columns[4, found] = leaf[row].first_time
                self.columns[5, found] = leaf[row].last_time
                found += 1
        return out[:, :found]

    def align(self, down: float) -> None:
        """Lower the scan to where the map lies, by so many m."""
        self.z -= down
        self.aligned = True

    def common(self, time: float) -> cython.double:
        """Correlation of this scan's pose error with that of another time, s."""
        if self.rules.correlation_time <= 0.0:
            return 0.0
        return exp(-fabs(self.now - time) / self.rules.correlation_time)

    def settle(self) -> None:
        """Fuse, judge and divide until no cell asks for it; then count the residuals."""
        i: cython.Py_ssize_t
        begin: cython.Py_ssize_t
        end: cython.Py_ssize_t
        levels: cython.Py_ssize_t
        self.ratio = np.empty((2, len(self.key)))
        self.ratios, self.weights = self.ratio[0], self.ratio[1]
        with cython.nogil:
            for i in range(self.cells):
                begin, end = self.begins[i], self.begins[i + 1]
                levels = self.table.max_level - self.table.leaf[self.rows[i]].level
                levels = min(3 * levels * (end - begin), (1 << (2 * levels)) - 1)
                if self.table.count + levels > self.table.capacity:
                    with cython.gil:
                        self.table.reserve(levels)
                self._settle(self.rows[i], begin, end, i, False)
        self.ratio = self.ratio[:, : self.rested]

    def _side(self, row: cython.Py_ssize_t) -> cython.double:
        return self.table.side(self.table.leaf[row].level)

    def _measure(
        self,
        row: cython.Py_ssize_t,
        begin: cython.Py_ssize_t,
        end: cython.Py_ssize_t,
        at: cython.Py_ssize_t,
    ) -> None:
        """Fit a run of points in a leaf."""
        leaf = self.table.leaf
        if leaf[row].known == NOTHING:
            leaf[row].normal[0] = leaf[row].normal[1] = 0.0
            leaf[row].normal[2] = 1.0
        measure(
            self.rules,
            self.points,
            begin,
            end,
            leaf[row].x - self.x,
            leaf[row].y - self.y,
            self._side(row),
            leaf[row].normal,
            self.sigma,
            self.runs,
            at,
        )

    def _judge(
        self,
        row: cython.Py_ssize_t,
        begin: cython.Py_ssize_t,
        end: cython.Py_ssize_t,
        at: cython.Py_ssize_t,
    ) -> None:
        """The division statistic of a run, before its fit is taken over.

        ``lack_of_fit``: mean residual about the run's own fit over range noise, with
        sqrt(N / (N - 3)), of expectation E[chi_1] on planar ground. ``mahalanobis``: the paper's
        mean d_M of prefit residuals; a measured leaf is judged by the plane it had, a new one by
        its fit ("the fit quality between measurements and the initial estimate").
        """
        basis = cython.declare(cython.double[6])
        through = cython.declare(cython.double[3])
        arm = cython.declare(cython.double[3])
        i: cython.int
        j: cython.int
        leaf = self.table.leaf
        count = self.runs[at].points
        if count <= 3.0:
            return
        if not self.rules.mahalanobis:
            distance = mean_distance(
                self.points, begin, end, self.runs[at].normal, self.runs[at].mean
            )
            self.runs[at].statistic = distance * sqrt(
                count / ((count - 3.0) * self.runs[at].variance)
            )
            return
        cosine = self.runs[at].cosine
        along = self.runs[at].variance / (cosine * cosine)
        if leaf[row].known != MEASURED:
            distance = mean_distance(
                self.points, begin, end, self.runs[at].normal, self.runs[at].mean
            )
            self.runs[at].statistic = distance * mahalanobis_factor(
                self.runs[at].normal, self.runs[at].mean, cosine, self.sigma, along, 0.0
            )
            return
        through[0], through[1] = leaf[row].x - self.x, leaf[row].y - self.y
        through[2] = leaf[row].z - self.z
        distance = mean_distance(self.points, begin, end, leaf[row].normal, through)
        basis_at(leaf[row].normal, basis)
        for i in range(3):
            arm[i] = self.runs[at].mean[i] - through[i]
        through[0] = -(basis[0] * arm[0] + basis[1] * arm[1] + basis[2] * arm[2])
        through[1] = -(basis[3] * arm[0] + basis[4] * arm[1] + basis[5] * arm[2])
        through[2] = 1.0
        plane = 0.0
        for i in range(3):
            for j in range(3):
                total = leaf[row].range_part[3 * i + j] + leaf[row].pose_part[3 * i + j]
                plane += through[i] * total * through[j]
        self.runs[at].statistic = distance * mahalanobis_factor(
            leaf[row].normal, self.runs[at].mean, cosine, self.sigma, along, plane
        )

    def _fuse(self, row: cython.Py_ssize_t, at: cython.Py_ssize_t, same_scan: cython.bint) -> None:
        """Fuse a run's fit with what the leaf knows (paper IV.C), however little either is.

        A first estimate of level ground is fused like any other. What a leaf inherited lies at the
        height of the map, as an aligned scan does, or at that of this very scan: then pose error
        is common to both, decides nothing between them and stays as it was.
        """
        rise = cython.declare(cython.double[1])
        i: cython.int
        leaf = self.table.leaf
        fresh: cython.bint = leaf[row].known <= HINTS
        if leaf[row].known == NOTHING:
            leaf[row].first_time = self.now
            leaf[row].z = self.runs[at].z + self.z
            for i in range(9):
                leaf[row].range_part[i] = leaf[row].pose_part[i] = 0.0
            leaf[row].range_part[0] = leaf[row].range_part[4] = LEVEL_SIGMA * LEVEL_SIGMA
            leaf[row].range_part[8] = HEIGHT_SIGMA * HEIGHT_SIGMA
        if same_scan or (self.aligned and leaf[row].known == INHERITED):
            common = 1.0
            for i in range(9):
                self.runs[at].pose_part[i] = leaf[row].pose_part[i]
        else:
            common = self.common(leaf[row].last_time)
        fuse(
            leaf[row].normal,
            leaf[row].z - self.z - self.runs[at].z,
            leaf[row].range_part,
            leaf[row].pose_part,
            self.runs[at].normal,
            self.runs[at].range_part,
            self.runs[at].pose_part,
            common,
            rise,
        )
        for i in range(3):
            leaf[row].normal[i] = self.runs[at].normal[i]
        leaf[row].z = self.runs[at].z + self.z + rise[0]
        leaf[row].points += self.runs[at].points
        leaf[row].last_time = self.now
        if fresh:
            steep = leaf[row].range_part[0] + leaf[row].range_part[4]
            if leaf[row].points < self.rules.min_points or steep > MAX_SLOPE_SIGMA**2:
                leaf[row].known = HINTS
                return
        leaf[row].known = MEASURED

    def _divide(self, row: cython.Py_ssize_t, at: cython.Py_ssize_t) -> cython.bint:
        """Divide a leaf above the finest level, if there is room.

        What the plane did not describe, its mean square residual, makes its height less certain to
        the children. Its slope is worth `slope_points` measurements that fill a child, which have
        the horizontal variance side^2 / 12.
        """
        leaf = self.table.leaf
        if leaf[row].level >= self.table.max_level:
            return False
        square = self.runs[at].variance
        if leaf[row].division_weight > 0.0:
            square = fmax(leaf[row].square_sum / leaf[row].division_weight, square)
        side = 0.5 * self._side(row)
        tilt = 12.0 * self.runs[at].variance / (self.rules.slope_points * side * side)
        if not self.table.divide(row, square, fmin(tilt, 1.0)):
            self.refused += 1
            return False
        self.divisions += 1
        return True

    def _settle(
        self,
        row: cython.Py_ssize_t,
        begin: cython.Py_ssize_t,
        end: cython.Py_ssize_t,
        at: cython.Py_ssize_t,
        same_scan: cython.bint,
    ) -> None:
        """Take a run of points, whose fit is at ``at``, into a leaf or its descendants."""
        fresh: cython.bint = self.table.leaf[row].known <= HINTS
        self._judge(row, begin, end, at)
        self._fuse(row, at, same_scan)
        if self.table.leaf[row].known != MEASURED:
            return
        asked: cython.bint = asks(self.rules, self.table.leaf, row, self.runs, at)
        if not (asked and self._divide(row, at)):
            self._rest(row, begin, end, at)
            if self.runs[at].unseen >= 0.5 or self.runs[at].points < self.rules.min_residuals:
                return
            if not hides_rock(self.rules, self.table.leaf, row, self._side(row)):
                return
            if asked or not self._divide(row, at):
                return
        self._go_on(row, begin, end, same_scan or fresh)

    @cython.boundscheck(False)
    def _go_on(
        self,
        row: cython.Py_ssize_t,
        begin: cython.Py_ssize_t,
        end: cython.Py_ssize_t,
        same_scan: cython.bint,
    ) -> None:
        """The quarters of a run go on in the leaves that their cell was divided into."""
        level: cython.int = self.table.leaf[row].level
        at: cython.Py_ssize_t = self.cells + level
        child: cython.Py_ssize_t
        stop: cython.Py_ssize_t
        while begin < end:
            child = self.table.over[self.key[begin]]
            stop = begin + 1
            while stop < end and self.table.over[self.key[stop]] == child:
                stop += 1
            self._measure(child, begin, stop, at)
            self._settle(child, begin, stop, at, same_scan)
            begin = stop

    @cython.boundscheck(False)
    def _rest(
        self,
        row: cython.Py_ssize_t,
        begin: cython.Py_ssize_t,
        end: cython.Py_ssize_t,
        at: cython.Py_ssize_t,
    ) -> None:
        """Points came to rest: the leaf's running statistics (Eq. 55, Eq. 48) and its feature.

        Residuals are n.(r - mean): without the scan's common offset in the cell, which pose error
        and not the ground explains; it takes one degree of freedom.
        """
        i: cython.Py_ssize_t
        leaf = self.table.leaf
        points = self.points
        residual = self.residual
        count = self.runs[at].points
        variance = self.runs[at].variance
        if count >= NOISE_POINTS:
            self.ratios[self.rested] = sqrt(self.runs[at].square / variance)
            self.weights[self.rested] = count
            self.rested += 1
        if count < 2.0:
            return
        n_x, n_y, n_z = leaf[row].normal[0], leaf[row].normal[1], leaf[row].normal[2]
        d = n_x * self.runs[at].mean[0] + n_y * self.runs[at].mean[1] + n_z * self.runs[at].mean[2]
        usual = variance
        if leaf[row].division_weight > 0.0:
            usual = leaf[row].square_sum / leaf[row].division_weight
        high = fmax(self.rules.rock_height, OUTSTANDING * sqrt(usual))
        clip = self.rules.clip
        total = raised = greatest = 0.0
        for i in range(begin, end):
            e = n_x * points[i, 0] + n_y * points[i, 1] + n_z * points[i, 2] - d
            residual[i] = e
            raised += 1.0 if e > high else 0.0
            e = fabs(e)
            greatest = e if e > greatest else greatest
            total += e if e < clip else clip
        noise = variance * (1.0 - 1.0 / count)
        leaf[row].distance_sum += total
        leaf[row].noise_sum += count * MEAN_CHI_1 * sqrt(noise)
        leaf[row].raised_sum += raised
        leaf[row].raised_noise += count * _above(self.rules.rock_height / sqrt(variance))
        # xi of a residual that is noise itself: the noise counts twice.
        leaf[row].exception_noise += (
            2.0 * count * _above(self.rules.tolerance / sqrt(2.0 * variance))
        )
        if greatest > self.rules.tolerance - 3.0 * sqrt(noise):
            leaf[row].exception_sum += self._exceptions(begin, end, sqrt(noise))
        leaf[row].residuals += count
        if self.rules.features:
            update_feature(
                self.rules,
                leaf,
                row,
                self.points,
                self.residual,
                begin,
                end,
                leaf[row].x - self.x,
                leaf[row].y - self.y,
                self._side(row),
                variance,
                self.heights,
            )

    @cython.boundscheck(False)
    def _exceptions(
        self, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, deviation: float
    ) -> cython.double:
        """Eq. 48's sum of xi: probability mass beyond the roughness tolerance t.

        xi = P(|e + s N(0, 1)| > t) with e the residual and s what range noise leaves in it. How
        uncertain the plane's slope is does not count: of a leaf that was seen in part that is the
        other part's.
        """
        i: cython.Py_ssize_t
        tolerance = self.rules.tolerance
        mass = 0.0
        for i in range(begin, end):
            e = fabs(self.residual[i])
            if e > tolerance - 3.0 * deviation:
                mass += _above((tolerance - e) / deviation) + _above((tolerance + e) / deviation)
        return mass
