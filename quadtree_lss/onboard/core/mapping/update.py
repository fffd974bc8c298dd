# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False
"""Update of the leaves by one scan: fit, fuse, divide, residual statistics (paper IV)."""

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.libc.math import INFINITY, fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry.plane import offset_variance
from cython.cimports.quadtree_lss.onboard.core.mapping import division, measure
from cython.cimports.quadtree_lss.onboard.core.mapping import update as row
from cython.cimports.quadtree_lss.onboard.core.mapping.features import update_feature
from cython.cimports.quadtree_lss.onboard.core.mapping.update import MAP_VARIANCE as MAP_VARIANCE
from cython.cimports.quadtree_lss.onboard.core.mapping.update import (
    NOISE_VARIANCE as NOISE_VARIANCE,
)
from cython.cimports.quadtree_lss.onboard.core.mapping.update import RISE as RISE
from cython.cimports.quadtree_lss.onboard.core.mapping.update import SCAN_VARIANCE as SCAN_VARIANCE
from cython.cimports.quadtree_lss.onboard.core.tree import leaves

from quadtree_lss.onboard.arrays import Array, Bytes, Keys, Points
from quadtree_lss.onboard.core.geometry.bounds import MAX_MAP_HEIGHT
from quadtree_lss.onboard.core.mapping.features import Heights
from quadtree_lss.onboard.core.mapping.fusion import Fusion
from quadtree_lss.onboard.core.mapping.measure import RUN, Rules
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.register import RegisteredScan
from quadtree_lss.onboard.core.tree.leaves import LeafTable, Record

#: A finest cell is explained if at most this share of its returns stands out: (6 cm / 25 cm)^2.
UNEXPLAINED_SHARE = cython.declare(cython.double, 1.0 / 16.0)
#: A finest cell is no longer explained when its plane moves by more than this share of
#: `division.unexplained_distance`.
MOVED_SHARE = cython.declare(cython.double, 0.75)
#: Standard deviations by which the mean height of a finest cell must exceed its plane to show a
#: rock; noise does so in two of 65,536 cells.
MOUND_SIGMAS = cython.declare(cython.double, 4.0)
#: Mean square misfit of a child over that of its parent: residuals are proportional to the width.
CHILD_MISFIT = cython.declare(cython.double, 0.25)
#: Weight of a parent's slope in a child, in points that fill the child. With half of it, 46 instead
#: of 52 % of the safe ground was kept with much noise, with as many hazards found.
SLOPE_POINTS = cython.declare(cython.double, 10.0)
#: Least points of a scan in a cell for an estimate of the range noise, and least z of its normal (a
#: slope of 30 degrees), which excludes facades and trees.
NOISE_POINTS = cython.declare(cython.double, 8.0)
MIN_NORMAL_Z = cython.declare(cython.double, 0.866)
#: Standard deviations of pose errors by which the beams must move for a new view (`is_new_view`):
#: errors of six degrees of freedom exceed it in 1 of 2,000 scans.
NEW_VIEW_SIGMAS = cython.declare(cython.double, 2.0)
#: Least share of a scan's points in estimated leaves that lie in comparable ones, for a test: sound
#: scans over simulated cliffs with up to 0.22 would be rejected.
COMPARABLE_SHARE = cython.declare(cython.double, 0.25)
#: Number of beams of a scan that are compared.
BEAMS = 16
#: Greatest height of a plane at a cell's centre, m.
HIGHEST = cython.declare(cython.double, MAX_MAP_HEIGHT)


def set_states(
    seen: Bytes, key: Keys, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, state: cython.uchar
) -> None:
    """Set the state of the finest cells under the points ``begin`` to ``end`` of keys (N,)."""
    i: cython.Py_ssize_t
    for i in range(begin, end):
        seen[key[i]] = state


def sampled_beams(points_lidar: Points) -> Array:
    """Return some points (K, 3) of a scan, m, at places that depend on its size only."""
    flat = points_lidar.reshape(-1, 3)
    return np.array(flat[:: max(len(flat) // BEAMS, 1)], dtype=np.float64)


def is_new_view(
    pose: Pose, beams: Array, last: Pose, last_beams: Array, independent: float
) -> cython.bint:
    """Return whether beams (K, 3), m, moved over the ground by more than pose errors explain, since
    another pose with its beams. Otherwise the returns are those of the same places again.
    ``independent``: share of the variances that the errors of both poses do not have in common."""
    i: cython.Py_ssize_t
    a = cython.declare(cython.double[:, ::1], beams)
    b = cython.declare(cython.double[:, ::1], last_beams)
    move = cython.declare(cython.double[3], (pose.position - last.position).tolist())
    variances = cython.declare(cython.double[6])
    variances = (pose.covariance.diagonal() + last.covariance.diagonal()).tolist()
    cosines: cython.double = np.vdot(pose.rotation_map_lidar, last.rotation_map_lidar)
    if a.shape[0] != b.shape[0]:
        return True
    square = turned = number = moved = variance = 0.0
    for i in range(a.shape[0]):
        one = a[i, 0] * a[i, 0] + a[i, 1] * a[i, 1] + a[i, 2] * a[i, 2]
        other = b[i, 0] * b[i, 0] + b[i, 1] * b[i, 1] + b[i, 2] * b[i, 2]
        both = a[i, 0] * b[i, 0] + a[i, 1] * b[i, 1] + a[i, 2] * b[i, 2]
        if 0.0 < one * other < INFINITY:  # two returns
            square += one
            turned += 2.0 - 2.0 * both / sqrt(one * other)
            number += 1.0
    if number == 0.0:
        return True
    square /= number
    # 2 (1 - cos) is nearly the squared angle; the trace of a rotation is 1 + 2 cos.
    turned = turned / number + 3.0 - cosines
    for i in range(3):
        moved += move[i] * move[i]
        variance += variances[i] + square * variances[i + 3]
    return moved + square * turned > NEW_VIEW_SIGMAS * NEW_VIEW_SIGMAS * independent * variance


class ScanBuffers:
    """Memory of a scan's points and cells, reused by the next scan (allocation took 5 % of a scan):
    first point and row of each cell, residual of each point, m, result of
    `ScanUpdate.update_leaves`, work space of `features.update_feature`, a `RUN` for each cell."""

    def __init__(self) -> None:
        self.points = self.cells = -1

    def reserve_points(self, points: cython.Py_ssize_t) -> None:
        """Grow; the contents are lost."""
        if points > self.points:
            self.points = points
            self.begins, self.rows = np.empty((2, points + 1), dtype=np.intp)
            self.residual = np.empty(points)
            # Cells of `NOISE_POINTS` or more on each of up to 12 levels.
            self.ratio = np.empty((2, 2 * points))
            self.heights = Heights(points)

    def reserve_runs(self, cells: cython.Py_ssize_t) -> None:
        """Grow; the contents are lost."""
        if cells > self.cells:
            self.cells = 2 * cells
            self.runs = np.empty(self.cells, dtype=RUN)


class ScanUpdate:
    """Update of a leaf table by one scan: `fit`, `lower` if it is aligned, then `update_leaves`.

    Attributes:
        is_comparable: Whether at least `COMPARABLE_SHARE` of the points in estimated leaves lie in
            those that `fit` compares.
        divisions, refused: Number of divisions, and of divisions beyond ``max_cells``.
    """

    def __init__(
        self, table: LeafTable, rules: Rules, scan: RegisteredScan, now: float, buffers: ScanBuffers
    ) -> None:
        count = len(scan.key)
        self.table = table
        self.fusion = Fusion(rules, scan, now)
        self.rules = rules
        self.points = scan.points
        self.key = scan.key
        self.buffers = buffers
        self.buffers.reserve_points(count)
        self.residual = self.buffers.residual
        self.divisions = self.refused = self.noise_count = 0
        self._find_runs()

    def _find_runs(self) -> None:
        """Find the runs of points that share a leaf, by exponential search."""
        i: cython.Py_ssize_t = 0
        step: cython.Py_ssize_t
        cells: cython.Py_ssize_t = 0
        count: cython.Py_ssize_t = len(self.key)
        row: cython.Py_ssize_t
        self.begins, self.rows = self.buffers.begins, self.buffers.rows
        while i < count:
            row = self.table.over[self.key[i]]
            self.begins[cells] = i
            self.rows[cells] = row
            cells += 1
            step = 1
            while i + step < count and self.table.over[self.key[i + step]] == row:
                i += step
                step *= 2
            while step > 1:
                step //= 2
                if i + step < count and self.table.over[self.key[i + step]] == row:
                    i += step
            i += 1
        self.begins[cells] = count
        self.cells = cells
        self.buffers.reserve_runs(cells + self.table.max_level + 1)
        self.runs = self.buffers.runs

    def fit(self) -> Array:
        """Fit a plane to the scan in each touched leaf; return the M comparable ones, (ROWS, M).

        The rows are `RISE`: height of the scan over the map, m; `NOISE_VARIANCE`: its variance
        without pose errors, m^2; `SCAN_VARIANCE`, `MAP_VARIANCE`: variance of either height from
        pose errors, m^2; `FIRST_TIME`, `LAST_TIME`: of the scans in the map's plane, s; `PLACE_X`,
        `PLACE_Y`, `PLACE_Z`: of the cell about the lidar, m; `SLOPE_X`, `SLOPE_Y`: of the map's
        plane; `SLOPE_VARIANCE`: variance of either from pose errors.
        """
        i: cython.Py_ssize_t
        found: cython.Py_ssize_t = 0
        estimated = compared = 0.0
        out = np.empty((row.ROWS, self.cells))
        self.columns = out
        with cython.nogil:
            for i in range(self.cells):
                self.table.prefetch_header(self.rows[min(i + 16, self.cells - 1)])
                leaf = self.table.at(self.rows[i])
                if leaf.state <= leaves.INCOMPLETE:
                    self._assume_level(leaf)
                    continue
                self.table.prefetch_leaf(self.rows[min(i + 4, self.cells - 1)])
                run = cython.address(self.runs[i])
                self._measure(leaf, self.begins[i], self.begins[i + 1], run)
                if leaf.state == leaves.ESTIMATED:
                    estimated += self.begins[i + 1] - self.begins[i]
                if self._comparable(leaf):
                    compared += self.begins[i + 1] - self.begins[i]
                    self._write_comparison(leaf, run, found)
                    found += 1
        self.is_comparable = compared >= COMPARABLE_SHARE * estimated
        return out[:, :found]

    def fit_finest(self) -> Array:
        """Return `RISE` to `MAP_VARIANCE` as (4, M), for the mean in each explained finest cell."""
        cython.declare(i=cython.Py_ssize_t, k=cython.Py_ssize_t)
        found: cython.Py_ssize_t = 0
        out = np.empty((4, len(self.key)))
        self.columns = out
        for i in range(self.cells):
            leaf = self.table.at(self.rows[i])
            if not self._comparable(leaf):
                continue
            run = cython.address(self.runs[i])
            up = leaf.normal[2]
            x, y = leaf.x - self.fusion.pose.origin[0], leaf.y - self.fusion.pose.origin[1]
            z = leaf.z - self.fusion.pose.origin[2]
            misfit = leaf.square_sum / max(leaf.division_weight, 1.0) - run.variance
            along_x, along_y = leaf.normal[0] / up, leaf.normal[1] / up
            total = count = 0.0
            for k in range(self.begins[i], self.begins[i + 1]):
                total += self.points[k, 2] - z
                total += along_x * (self.points[k, 0] - x) + along_y * (self.points[k, 1] - y)
                count += 1.0
                if k + 1 == self.begins[i + 1] or self.key[k + 1] != self.key[k]:
                    if self.table.seen[self.key[k]] == leaves.EXPLAINED:
                        own = run.variance / count + leaf.range_part[8]
                        self.columns[row.RISE, found] = total / count
                        self.columns[row.NOISE_VARIANCE, found] = own / (up * up) + max(misfit, 0.0)
                        self.columns[row.SCAN_VARIANCE, found] = run.pose_part[8] / (up * up)
                        self.columns[row.MAP_VARIANCE, found] = leaf.pose_part[8] / (up * up)
                        found += 1
                    total = count = 0.0
        return out[:, :found]

    def _comparable(self, leaf: Record) -> cython.bint:
        """Return whether the leaf is estimated, and not divided from rough ground (tree crowns),
        where planes depend on the returns of a scan more than on its pose."""
        return leaf.state == leaves.ESTIMATED and leaf.parent_misfit <= self.rules.slack

    def _write_comparison(self, leaf: Record, run: Record, at: cython.Py_ssize_t) -> None:
        """Write a column of the result of `fit`. Few points are compared at their centroid, because
        at the cell's centre they depend on the map's slope."""
        place = cython.declare(cython.double[3])
        square = leaf.normal[2] * leaf.normal[2]
        own = run.range_part[8] + leaf.range_part[8]
        misfit = leaf.square_sum / max(leaf.division_weight, 1.0) - run.variance
        self.columns[row.RISE, at] = run.z + self.fusion.pose.origin[2] - leaf.z
        if measure.has_few_points(run):
            self.fusion.offset_at(leaf, run, place)
            own = run.variance / run.points + offset_variance(leaf.range_part, place[0], place[1])
            self.columns[row.RISE, at] = place[2]
        seen = max(1.0 - run.unobserved, 0.1)
        own += self.rules.uneven * (1.0 / (seen * seen) - 1.0)
        self.columns[row.NOISE_VARIANCE, at] = own / square + max(misfit, 0.0)
        pose = run.pose_part[8]
        if self.rules.independent:  # no part of a plane, but of the scan
            pose = measure.pose_variance(leaf.normal, run.centroid, self.fusion.pose.sigma)
        self.columns[row.SCAN_VARIANCE, at] = pose / square
        self.columns[row.MAP_VARIANCE, at] = leaf.pose_part[8] / square
        self.columns[row.FIRST_TIME, at] = leaf.first_time
        self.columns[row.LAST_TIME, at] = leaf.last_time
        self.columns[row.PLACE_X, at] = leaf.x - self.fusion.pose.origin[0]
        self.columns[row.PLACE_Y, at] = leaf.y - self.fusion.pose.origin[1]
        self.columns[row.PLACE_Z, at] = run.z
        self.columns[row.SLOPE_X, at] = -leaf.normal[0] / leaf.normal[2]
        self.columns[row.SLOPE_Y, at] = -leaf.normal[1] / leaf.normal[2]
        tilt = 0.5 * (leaf.pose_part[0] + leaf.pose_part[4])
        self.columns[row.SLOPE_VARIANCE, at] = tilt / (square * square)

    def lower(self, down: float) -> None:
        """Lower the scan by ``down``, m."""
        self.fusion.pose.origin[2] -= down
        self.fusion.aligned = True

    def update_leaves(self, is_new: cython.bint) -> Array:
        """Fuse the fits, divide where a plane does not suffice, update residual statistics.
        ``is_new``: it is a new view, which adds coverage. Return (2, R) for the cells with an
        estimate of the range noise, valid until the next scan: observed over configured standard
        deviation, and points."""
        cython.declare(i=cython.Py_ssize_t, begin=cython.Py_ssize_t, end=cython.Py_ssize_t)
        cython.declare(levels=cython.Py_ssize_t)
        self.is_new = is_new
        with cython.nogil:
            for i in range(self.cells):
                self.table.prefetch_leaf(self.rows[min(i + 4, self.cells - 1)])
                begin, end = self.begins[i], self.begins[i + 1]
                leaf, run = self.table.at(self.rows[i]), cython.address(self.runs[i])
                if leaf.state <= leaves.INCOMPLETE:
                    run = cython.address(self.runs[self.cells])
                    self._measure(leaf, begin, end, run)
                levels = self.table.max_level - leaf.level
                if levels > 0:
                    levels = min(3 * levels * (end - begin), (1 << (2 * levels)) - 1)
                    if self.table.count + levels > self.table.capacity:
                        with cython.gil:
                            self.table.reserve(levels)
                self._update_leaf(self.rows[i], begin, end, run, False)
        return np.asarray(self.buffers.ratio)[:, : self.noise_count]

    def _assume_level(self, leaf: Record) -> None:
        """Start with level ground in a leaf without any information."""
        if leaf.state == leaves.UNKNOWN:
            leaf.normal[0] = leaf.normal[1] = 0.0
            leaf.normal[2] = 1.0

    def _measure(
        self, leaf: Record, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, run: Record
    ) -> None:
        """Fit the points ``begin`` to ``end`` in a leaf."""
        points, pose = cython.address(self.points[begin, 0]), cython.address(self.fusion.pose)
        side = self.table.sides[leaf.level]
        measure.measure(self.rules, leaf, run, points, end - begin, pose, side)

    def _divide(self, row: cython.Py_ssize_t, run: Record) -> cython.bint:
        """Divide a leaf, unless it is a finest cell or ``max_cells`` is reached.

        The misfit counts twice in the slope, because neighbouring residuals are correlated. The
        children keep it, because their points may not show it.
        """
        leaf = self.table.at(row)
        if leaf.level >= self.table.max_level:
            return False
        square = run.variance
        if leaf.division_weight > 0.0:
            square = max(leaf.square_sum / leaf.division_weight, square)
        uneven = max(division.misfit_square(leaf, run.variance), leaf.parent_misfit)
        side = 0.5 * self.table.sides[leaf.level]
        tilt = run.variance + 2.0 * uneven
        tilt *= 12.0 / (SLOPE_POINTS * side * side)
        spread = division.unexplained_distance(self.rules, leaf, run.variance)
        if not self.table.divide(row, square, tilt, spread, CHILD_MISFIT * uneven):
            self.refused += 1
            return False
        self.divisions += 1
        return True

    def _update_leaf(
        self,
        row: cython.Py_ssize_t,
        begin: cython.Py_ssize_t,
        end: cython.Py_ssize_t,
        run: Record,
        same_scan: cython.bint,
    ) -> None:
        """Update a leaf, or its descendants if it is divided, with a run of points.

        A new leaf whose points do not determine a plane waits while they cover more of its width
        with each scan, and is divided otherwise. A partial view is compared with the plane before
        fusion, because a rock that fills the view would turn it.
        """
        leaf, points = self.table.at(row), cython.address(self.points[begin, 0])
        pose, side = cython.address(self.fusion.pose), self.table.sides[leaf.level]
        if self.fusion.is_elsewhere(leaf, run):
            leaf.points -= run.points
            if leaf.points > 0.0:
                if run.points > 1.0:  # a single return is not evidence
                    set_states(self.table.seen, self.key, begin, end, leaves.OBSERVED)
                else:
                    self._raise_states(begin, end, leaves.OBSERVED)
                return
            self.table.reset_leaf(leaf)
            self._measure(leaf, begin, end, run)
        fresh: cython.bint = leaf.state <= leaves.INCOMPLETE
        if fresh and run.has_slope == 0.0:
            seen = 1.0 - run.unobserved
            grows: cython.bint = seen > leaf.strip_width
            leaf.strip_width = max(leaf.strip_width, seen)
            enough: cython.bint = run.points >= division.MIN_RESIDUALS
            enough = enough and not self.rules.mahalanobis
            if enough and not grows and self._divide(row, run):
                self._update_children(row, begin, end, False)
            else:
                self._raise_states(begin, end, leaves.OBSERVED)
            return
        if leaf.state >= leaves.INHERITED:
            self.fusion.limit_offset(leaf, run)
            partial: cython.bint = measure.is_partial(run) and leaf.level < self.table.max_level
            partial = partial and not self.rules.mahalanobis
            if partial and division.view_shows_misfit(
                self.rules, leaf, run, points, pose.origin, side
            ):
                self._update_residuals(leaf, begin, end, run)
                if self._divide(row, run):
                    self._update_children(row, begin, end, False)
                    return
        if not measure.has_few_points(run):
            division.set_statistic(self.rules, leaf, run, points, pose)
        x, y, z, up = leaf.normal[0], leaf.normal[1], leaf.z, leaf.normal[2]
        self.fusion.fuse(leaf, run, same_scan)
        if not fabs(leaf.z) < HIGHEST:
            self.table.reset_leaf(leaf)
            self._raise_states(begin, end, leaves.OBSERVED)
            return
        if not fresh:
            turn_x = x / up - leaf.normal[0] / leaf.normal[2]
            turn_y = y / up - leaf.normal[1] / leaf.normal[2]
            most = MOVED_SHARE * division.unexplained_distance(self.rules, leaf, run.variance)
            if fabs(leaf.z - z) + 0.5 * side * (fabs(turn_x) + fabs(turn_y)) > most:
                if not self.table.unmark_moved(leaf, leaf.z - z, turn_x, turn_y, most):
                    leaf.low, leaf.high = INFINITY, -INFINITY
        if leaf.state != leaves.ESTIMATED:
            self._raise_states(begin, end, leaves.OBSERVED)
            return
        division.add_statistic(self.rules, leaf, run)
        asked: cython.bint = division.misfit_divides(self.rules, leaf, run)
        if asked and leaf.level < self.table.max_level:
            self._update_residuals(leaf, begin, end, run)
        if not (asked and self._divide(row, run)):
            self._update_statistics(leaf, begin, end, run)
            if asked or leaf.level == self.table.max_level:
                return
            mound: cython.bint = self._shows_mound(begin, end, run.variance, 1.0)
            misfit: cython.bint = division.residuals_divide(self.rules, leaf)
            rock: cython.bint = mound or misfit or division.shows_rock(self.rules, leaf)
            if self.rules.mahalanobis or not rock:
                return
            if not self._divide(row, run):
                return
            self._shows_mound(begin, end, run.variance, -1.0)  # the children add them again
        self._update_children(row, begin, end, same_scan or fresh)

    def _update_children(
        self,
        row: cython.Py_ssize_t,
        begin: cython.Py_ssize_t,
        end: cython.Py_ssize_t,
        same_scan: cython.bint,
    ) -> None:
        """Update the children of a divided leaf, each with its part of the run."""
        run = cython.address(self.runs[self.cells + self.table.leaf[row].level])
        cython.declare(child=cython.Py_ssize_t, stop=cython.Py_ssize_t)
        while begin < end:
            child = self.table.over[self.key[begin]]
            stop = begin + 1
            while stop < end and self.table.over[self.key[stop]] == child:
                stop += 1
            leaf = self.table.at(child)
            self._assume_level(leaf)
            self._measure(leaf, begin, stop, run)
            self._update_leaf(child, begin, stop, run, same_scan)
            begin = stop

    def _raise_states(
        self, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, state: cython.uchar
    ) -> None:
        """Raise the states of the finest cells of a run to at least ``state``."""
        i: cython.Py_ssize_t
        for i in range(begin, end):
            if self.table.seen[self.key[i]] < state:
                self.table.seen[self.key[i]] = state

    def _record_hits(self, begin: cython.Py_ssize_t, end: cython.Py_ssize_t) -> None:
        """Record in which of the 4 x 4 parts of their finest cells the points of a run fell: all
        points of a new view, otherwise only the first point of a cell."""
        cython.declare(i=cython.Py_ssize_t, column=cython.int, line=cython.int)
        per = 4.0 / self.table.sides[self.table.max_level]
        x = (self.fusion.pose.origin[0] - self.table.xmin) * per
        y = (self.fusion.pose.origin[1] - self.table.ymin) * per
        for i in range(begin, end):
            if self.table.hits[self.key[i]] == 0xFFFF or (
                self.table.hits[self.key[i]] > 0 and not self.is_new
            ):
                continue
            column = cython.cast(cython.int, self.points[i, 0] * per + x)
            line = cython.cast(cython.int, self.points[i, 1] * per + y)
            self.table.hits[self.key[i]] |= 1 << ((column & 3) | (line & 3) << 2)

    def _update_residuals(
        self, leaf: Record, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, run: Record
    ) -> None:
        """Compute the residuals of a run, and the states of its finest cells: unexplained if more
        than `UNEXPLAINED_SHARE` of the returns, and at least two, stand out from the plane."""
        cython.declare(i=cython.Py_ssize_t)
        out = count = 0.0
        self._record_hits(begin, end)
        points = cython.address(self.points[begin, 0])
        residual = cython.address(self.residual[begin])
        division.add_residuals(self.rules, leaf, run, points, residual, self.fusion.pose.origin)
        if run.max_residual <= run.raised_limit:
            set_states(self.table.seen, self.key, begin, end, leaves.EXPLAINED)
            return
        for i in range(begin, end):
            count += 1.0
            if fabs(self.residual[i]) > run.raised_limit:
                out += 1.0
            if i == end - 1 or self.key[i + 1] != self.key[i]:
                if out <= UNEXPLAINED_SHARE * count:
                    self.table.seen[self.key[i]] = leaves.EXPLAINED
                elif out > 1.0:
                    self.table.seen[self.key[i]] = leaves.UNEXPLAINED
                else:
                    self._raise_states(i, i + 1, leaves.OBSERVED)
                out = count = 0.0

    def _shows_mound(
        self, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, variance: float, sign: float
    ) -> cython.bint:
        """Add a run to the piles of its finest cells (``sign`` -1: remove it again); return whether
        the mean height of one shows a rock that noise of this variance hides in each scan."""
        i: cython.Py_ssize_t
        found: cython.bint = False
        total = count = 0.0
        for i in range(begin, end):
            total += self.residual[i]
            count += 1.0
            if i == end - 1 or self.key[i + 1] != self.key[i]:
                total = self.table.pile[self.key[i], 0] + sign * total
                count = self.table.pile[self.key[i], 1] + sign * count
                self.table.pile[self.key[i], 0] = cython.cast(cython.float, total)
                self.table.pile[self.key[i], 1] = cython.cast(cython.float, count)
                high: cython.bint = total > self.rules.mound_height * count
                found |= high and total * total > MOUND_SIGMAS * MOUND_SIGMAS * variance * count
                total = count = 0.0
        return found

    def _update_statistics(
        self, leaf: Record, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, run: Record
    ) -> None:
        """Update the residual statistics and the feature of a leaf."""
        if run.points >= NOISE_POINTS and leaf.normal[2] >= MIN_NORMAL_Z:
            self.buffers.ratio[0, self.noise_count] = sqrt(run.square / run.variance)
            self.buffers.ratio[1, self.noise_count] = run.points
            self.noise_count += 1
        self._update_residuals(leaf, begin, end, run)
        points = cython.address(self.points[begin, 0])
        residual = cython.address(self.residual[begin])
        origin, side = self.fusion.pose.origin, self.table.sides[leaf.level]
        update_feature(self.rules, leaf, run, points, residual, origin, side, self.buffers.heights)
