# SPDX-License-Identifier: Apache-2.0
"""What one scan does to the leaves: fit, fuse, judge, divide, come to rest (paper IV)."""

from __future__ import annotations

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes, Keys
from quadtree_lss.onboard.core.geometry.bounds import HEIGHTS
from quadtree_lss.onboard.core.geometry.sphere import Vector
from quadtree_lss.onboard.core.mapping.measure import Rules
from quadtree_lss.onboard.core.mapping.room import KEPT_POINTS, Room
from quadtree_lss.onboard.core.sensing.register import RegisteredScan
from quadtree_lss.onboard.core.tree.leaves import LeafTable, Record

if not cython.compiled:
    from math import exp, fabs, inf, nan, sqrt

    from quadtree_lss.onboard.core.geometry.plane import fuse, offset_variance
    from quadtree_lss.onboard.core.geometry.sphere import basis_at
    from quadtree_lss.onboard.core.mapping.division import asks, hides_rock, judge, rough
    from quadtree_lss.onboard.core.mapping.features import update_feature
    from quadtree_lss.onboard.core.mapping.measure import (
        few,
        measure,
        partial,
        pose_variance,
        record,
    )
    from quadtree_lss.onboard.core.mapping.residuals import departs, rest, standing_out

    NOTHING, HINTS, INHERITED, MEASURED = range(4)
    SEEN, KNOWN, OUT = 1, 2, 3
    INFINITE = inf
    NAN = nan


#: Share of a finest cell, of 6 cm in 25, on which nothing stands out that matters.
FEW = cython.declare(cython.double, 1.0 / 16.0)
#: A slope less certain than this (rad, one sigma) is none.
MAX_SLOPE_SIGMA = cython.declare(cython.double, 0.3)
#: Before anything is known, ground is level but for this (rad, one sigma) ...
LEVEL_SIGMA = cython.declare(cython.double, 0.5)
#: ... and this high or low, m.
HEIGHT_SIGMA = cython.declare(cython.double, 1e3)
#: Variance of the places of a first plane along the ray, over that of noise, at least.
APART = cython.declare(cython.double, 4.0)
#: Noise turns no plane by more, rad.
TURNED = cython.declare(cython.double, 1.5)
#: A plane that moved by such a share of what stands out is another one.
MOVED = cython.declare(cython.double, 0.75)
#: A run contradicts a plane that is so many deviations off.
CONTRADICTING = cython.declare(cython.double, 30.0)
#: The mean of a finest cell's returns rises so many deviations over a plane: of 65,536 cells noise
#: lifts two so far.
PILED = cython.declare(cython.double, 4.0)
#: Points of a scan in a cell that tell the range noise.
NOISE_POINTS = cython.declare(cython.double, 8.0)
#: A first plane so many deviations from that of a prior does not begin from it.
BEGINNING = cython.declare(cython.double, 3.0)
#: A plane is higher or lower at no cell's centre, m.
HIGHEST = cython.declare(cython.double, HEIGHTS)
#: A leaf begins from nothing.
NO_PRIOR = np.empty((0, 5))


@cython.boundscheck(False)
def know(seen: Bytes, key: Keys, begin: cython.Py_ssize_t, end: cython.Py_ssize_t) -> None:
    """The finest cells under the points ``begin`` to ``end``, of these keys (N,), are `KNOWN`."""
    i: cython.Py_ssize_t
    for i in range(begin, end):
        seen[key[i]] = KNOWN


class ScanUpdate:
    """One scan on its way through the leaves.

    Points lie about the lidar, in Morton order, so that those of a cell of any level are one run.

    Attributes:
        cells: Leaves that the scan touches.
        divisions, refused: Cells divided, and divisions for which there was no room.
        ratio: (2, R) of the cells in which points came to rest and that tell the range noise:
            observed over configured deviation, and points; until the next scan.

    Of a prior, ``beginning`` holds what `prior.Planes.beginning` says of the coarsest cells.
    """

    def __init__(
        self,
        table: LeafTable,
        rules: Rules,
        scan: RegisteredScan,
        now: float,
        beginning: Array | None = None,
        room: Room | None = None,
    ) -> None:
        count = len(scan.key)
        self.table = table
        self.begins_so = beginning is not None
        self.beginning = NO_PRIOR if beginning is None else beginning
        self.coarsest = table.domain.min_level
        self.rules = rules
        rules.look(scan.pose.rotation_map_lidar[:, 2])
        self.points = scan.points
        self.key = scan.key
        x, y, z = scan.origin.tolist()
        self.origin = [x, y, z]
        self.sigma = scan.pose.covariance
        self.aligned = False
        self.now = self.common_at = now
        self.common_is = 1.0
        self.room = Room() if room is None or count > KEPT_POINTS else room
        self.room.hold(count)
        self.residual = self.room.residual
        self.divisions = self.refused = self.rested = 0
        self._gather()

    @cython.boundscheck(False)
    def _gather(self) -> None:
        """The runs of points that share a leaf: in steps that double until one leads out of it, and
        then halve."""
        i: cython.Py_ssize_t = 0
        step: cython.Py_ssize_t
        cells: cython.Py_ssize_t = 0
        count: cython.Py_ssize_t = len(self.key)
        row: cython.Py_ssize_t
        self.begins, self.rows = self.room.begins, self.room.rows
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
        self.room.hold_runs(cells + self.table.max_level + 1)
        self.runs = self.room.runs

    def fit(self) -> Array:
        """Fit every touched leaf; the scan and the map in the M that were measured before, (12, M).

        The scan's height over the map, m, variance of that but for pose error, variance of the
        scan's height and of the map's from pose error, m^2, first and last time in the map, s;
        the cell's place about the lidar, x, y, z, m, the map's slope along x and along y, and the
        variance of that from pose error.
        """
        i: cython.Py_ssize_t
        found: cython.Py_ssize_t = 0
        out = np.empty((12, self.cells))
        self.columns = out
        with cython.nogil:
            for i in range(self.cells):
                self.table.expect(self.rows[min(i + 4, self.cells - 1)])
                leaf = self.table.at(self.rows[i])
                run = record(self.runs, i)
                self._measure(leaf, self.begins[i], self.begins[i + 1], run)
                if leaf.known == MEASURED:
                    self._compare(leaf, run, found)
                    found += 1
        return out[:, :found]

    def _compare(self, leaf: Record, run: Record, at: cython.Py_ssize_t) -> None:
        """One column of what `fit` returns; few points are compared where they lie, for what they
        say of the cell's centre is the slope that the map has."""
        place = cython.declare(cython.double[3])
        square = leaf.normal[2] * leaf.normal[2]
        own = run.range_part[8] + leaf.range_part[8]
        misfit = leaf.square_sum / max(leaf.division_weight, 1.0) - run.variance
        self.columns[0, at] = run.z + self.origin[2] - leaf.z
        if few(run):
            self._place(leaf, run, place)
            own = run.variance / run.points + offset_variance(leaf.range_part, place[0], place[1])
            self.columns[0, at] = place[2]
        self.columns[1, at] = own / square + max(misfit, 0.0)
        pose = run.pose_part[8]
        if self.rules.independent:  # no part of a plane, but of the scan
            pose = pose_variance(leaf.normal, run.centroid, self.sigma)
        self.columns[2, at] = pose / square
        self.columns[3, at] = leaf.pose_part[8] / square
        self.columns[4, at] = leaf.first_time
        self.columns[5, at] = leaf.last_time
        self.columns[6, at] = leaf.x - self.origin[0]
        self.columns[7, at] = leaf.y - self.origin[1]
        self.columns[8, at] = run.z
        self.columns[9, at] = -leaf.normal[0] / leaf.normal[2]
        self.columns[10, at] = -leaf.normal[1] / leaf.normal[2]
        tilt = 0.5 * (leaf.pose_part[0] + leaf.pose_part[4])
        self.columns[11, at] = tilt / (square * square)

    def align(self, down: float) -> None:
        """Lower the scan to where the map lies, by so many m."""
        self.origin[2] -= down
        self.aligned = True

    def common(self, time: float) -> cython.double:
        """Correlation of this scan's pose error with that of another time, s."""
        if self.rules.correlation_time <= 0.0:
            return 0.0
        if time != self.common_at:  # many leaves were last seen by the same scan
            self.common_at = time
            self.common_is = exp(-fabs(self.now - time) / self.rules.correlation_time)
        return self.common_is

    def settle(self) -> None:
        """Fuse, judge and divide until no cell asks for it; then count the residuals."""
        cython.declare(i=cython.Py_ssize_t, begin=cython.Py_ssize_t, end=cython.Py_ssize_t)
        cython.declare(levels=cython.Py_ssize_t)
        self.ratios, self.weights = self.room.ratios, self.room.weights
        with cython.nogil:
            for i in range(self.cells):
                self.table.expect(self.rows[min(i + 4, self.cells - 1)])
                begin, end = self.begins[i], self.begins[i + 1]
                levels = self.table.max_level - self.table.at(self.rows[i]).level
                levels = min(3 * levels * (end - begin), (1 << (2 * levels)) - 1)
                if self.table.count + levels > self.table.capacity:
                    with cython.gil:
                        self.table.reserve(levels)
                self._settle(self.rows[i], begin, end, record(self.runs, i), False)
        self.ratio = self.room.ratio[:, : self.rested]

    def _measure(
        self, leaf: Record, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, run: Record
    ) -> None:
        """Fit a run of points in a leaf."""
        if leaf.known == NOTHING:
            leaf.normal[0] = leaf.normal[1] = 0.0
            leaf.normal[2] = 1.0
        x = leaf.x - self.origin[0]
        y = leaf.y - self.origin[1]
        side = self.table.side(leaf.level)
        z = leaf.z - self.origin[2] if leaf.known != NOTHING else NAN
        measure(self.rules, self.points, begin, end, x, y, z, side, leaf.normal, self.sigma, run)

    def _contradicts(self, leaf: Record, run: Record) -> cython.bint:
        """Whether a run is of another place altogether than a plane, beyond any covariance.

        A scan with a wrong pose over ground that no other had seen leaves such planes; to average
        with them would keep them for ever. They are kept apart, and points are votes.
        """
        if leaf.known < INHERITED:
            return False
        variance = leaf.range_part[8] + leaf.pose_part[8] + run.range_part[8] + run.pose_part[8]
        off = (leaf.z - self.origin[2] - run.z) * leaf.normal[2]
        return off * off > CONTRADICTING * CONTRADICTING * (variance + self.rules.slack)

    def _place(self, leaf: Record, run: Record, out: Vector) -> None:
        """Where a leaf's plane is at the middle of a run, from its centre along its tangent axes,
        and how high the run lies over it there (3), m."""
        basis = cython.declare(cython.double[6])
        basis_at(leaf.normal, basis)
        x = run.centroid[0] - (leaf.x - self.origin[0])
        y = run.centroid[1] - (leaf.y - self.origin[1])
        z = -(leaf.normal[0] * x + leaf.normal[1] * y) / leaf.normal[2]
        out[0] = basis[0] * x + basis[1] * y + basis[2] * z
        out[1] = basis[3] * x + basis[4] * y + basis[5] * z
        out[2] = run.centroid[2] - z - (leaf.z - self.origin[2])

    def _doubt(self, leaf: Record, run: Record) -> None:
        """How far a run may lie off a leaf's plane where it was seen and both be right, m.

        Twice the deviation: of the plane at the run's place, of the run, of what a plane leaves
        out that passes for one, and what is news of the pose's error. Its height is taken out
        where the scan was aligned. Besides, the share of its offset that is the plane's and the
        pose's, p / (p + v / N) with their variance p and that of noise v.
        """
        place = cython.declare(cython.double[3])
        self._place(leaf, run, place)
        first, second = place[0], place[1]
        factor = self.rules.division_factor
        own = run.variance * (1.0 / run.points + factor * factor - 1.0)
        news = 1.0 - self.common(leaf.last_time)
        known = offset_variance(leaf.pose_part, first, second)
        high = leaf.normal[2] * leaf.normal[2] * self.sigma[2, 2] if self.aligned else 0.0
        plane = offset_variance(leaf.range_part, first, second)
        run.doubt = 2.0 * sqrt(own + plane + news * max(known + run.pose_part[8] - 2.0 * high, 0.0))
        plane += news * (known + max(run.pose_part[8] - high, 0.0))
        run.shared = plane / (plane + run.variance / run.points)

    def _fuse(self, leaf: Record, run: Record, same_scan: cython.bint) -> None:
        """Fuse a run's fit with what the leaf knows (paper IV.C), however little either is.

        A first estimate of level ground is fused like any other. What a leaf inherited lies at the
        height of the map, as an aligned scan does, or at that of this very scan: then pose error
        is common to both, decides nothing between them and stays as it was. But what an aligned
        scan is off sideways slopes make a height, which is news: n_xy^T C n_xy, C the covariance of
        its ground's place.
        """
        rise = cython.declare(cython.double[1])
        sideways = cython.declare(cython.double[3])
        i: cython.int
        fresh: cython.bint = leaf.known <= HINTS
        if leaf.known == NOTHING:
            leaf.first_time = self.now
            leaf.z = run.z + self.origin[2]
            for i in range(9):
                leaf.range_part[i] = leaf.pose_part[i] = 0.0
            leaf.range_part[0] = leaf.range_part[4] = LEVEL_SIGMA * LEVEL_SIGMA
            leaf.range_part[8] = HEIGHT_SIGMA * HEIGHT_SIGMA
        if same_scan or (self.aligned and leaf.known == INHERITED):
            common = 1.0
            if not same_scan:
                sideways[0], sideways[1], sideways[2] = run.normal[0], run.normal[1], 0.0
                news = 1.0 - self.common(leaf.last_time)
                run.range_part[8] += news * pose_variance(sideways, run.centroid, self.sigma)
            for i in range(9):
                run.pose_part[i] = leaf.pose_part[i]
        else:
            common = self.common(leaf.last_time)
        fuse(
            leaf.normal,
            leaf.z - self.origin[2] - run.z,
            leaf.range_part,
            leaf.pose_part,
            run.normal,
            run.range_part,
            run.pose_part,
            common,
            run.sloped > 0.0,
            rise,
        )
        for i in range(3):
            leaf.normal[i] = run.normal[i]
        leaf.z = run.z + self.origin[2] + rise[0]
        leaf.points += run.points
        leaf.bias[2] += run.bias[2]
        leaf.bias[0] += run.bias[2] / max(leaf.bias[2], 1e-300) * (run.bias[0] - leaf.bias[0])
        leaf.bias[1] += run.points / leaf.points * (run.bias[1] - leaf.bias[1])
        leaf.last_time = self.now
        if fresh:
            steep = leaf.range_part[0] + leaf.range_part[4]
            few: cython.bint = leaf.points < self.rules.min_points
            if few or steep > MAX_SLOPE_SIGMA**2 or not self._apart(leaf, run):
                leaf.known = HINTS
                return
        if leaf.bias[2] == 0.0:
            turn = self._turn(leaf, run)
            leaf.bias[0] = max(leaf.bias[0], turn) if leaf.known == INHERITED else turn
        if fresh and self.begins_so:
            self._begin(leaf)
        leaf.known = MEASURED

    def _begin(self, leaf: Record) -> None:
        """What a prior says of a leaf, fused with the first plane that points alone told of it.

        That is the same as to begin from the prior, whatever comes first, but that a leaf is
        measured no sooner for it, and that a prior of other ground is left out: one that is more
        than `BEGINNING` deviations off in height or slope.
        """
        normal = cython.declare(cython.double[3])
        known = cython.declare(cython.double[9])
        pose = cython.declare(cython.double[9])
        rise = cython.declare(cython.double[1])
        i: cython.int
        down: cython.int = leaf.level - self.coarsest
        ix: cython.int = leaf.ix >> down
        iy: cython.int = leaf.iy >> down
        at: cython.Py_ssize_t = (cython.cast(cython.Py_ssize_t, iy) << self.coarsest) + ix
        side = self.table.side(self.coarsest)
        x = ((leaf.ix + 0.5) / (1 << down) - ix - 0.5) * side
        y = ((leaf.iy + 0.5) / (1 << down) - iy - 0.5) * side
        a, b = self.beginning[at, 1], self.beginning[at, 2]
        square = 1.0 / (a * a + b * b + 1.0)
        tilt = self.beginning[at, 3] * square
        for i in range(9):
            known[i] = pose[i] = 0.0
        known[0] = known[4] = tilt
        known[8] = self.beginning[at, 4] * square + tilt * (x * x + y * y)
        off = self.beginning[at, 0] + a * x + b * y - leaf.z
        normal[2] = sqrt(square)
        normal[0], normal[1] = -a * normal[2], -b * normal[2]
        x, y = leaf.normal[0] - normal[0], leaf.normal[1] - normal[1]
        own = leaf.range_part[8] + leaf.pose_part[8]
        turn = leaf.range_part[0] + leaf.range_part[4] + leaf.pose_part[0] + leaf.pose_part[4]
        most = BEGINNING * BEGINNING
        # A place that the prior does not cover is not a number, and not near.
        if not (off * off * square <= most * (known[8] + own)):
            return
        if not (x * x + y * y <= most * (2.0 * tilt + turn)):
            return
        of_range = leaf.range_part
        of_pose = leaf.pose_part
        fuse(normal, off, known, pose, leaf.normal, of_range, of_pose, 0.0, True, rise)
        for i in range(9):
            of_range[i], of_pose[i] = known[i], pose[i]
        leaf.z += rise[0]

    def _along(self, leaf: Record, run: Record, out: Vector) -> None:
        """The ray to a run, of length one, along the tangent axes of a leaf's plane (2)."""
        basis = cython.declare(cython.double[6])
        basis_at(leaf.normal, basis)
        x, y, z = run.centroid[0], run.centroid[1], run.centroid[2]
        per = 1.0 / sqrt(x * x + y * y + z * z)
        out[0] = per * (basis[0] * x + basis[1] * y + basis[2] * z)
        out[1] = per * (basis[3] * x + basis[4] * y + basis[5] * z)

    def _height(self, known: Vector) -> cython.double:
        """Variance of a plane's height where its slope does not matter, m^2."""
        x = known[4] * known[2] - known[1] * known[5]
        y = known[0] * known[5] - known[1] * known[2]
        share = 1.0 / max(known[0] * known[4] - known[1] * known[1], 1e-300)
        return known[8] - share * (x * known[2] + y * known[5])

    def _turn(self, leaf: Record, run: Record) -> cython.double:
        """What noise along the ray may turn a plane by of which lines of points alone tell, rad.

        A^-1 q, as of a fit (`measure._bias`). Here A is the covariance of the places of all scans
        together. It follows from the covariance V of the slope and the variance h of the height:
        A^-1 = V / h.
        """
        ray = cython.declare(cython.double[2])
        self._along(leaf, run, ray)
        known = leaf.range_part
        x = known[0] * ray[0] + known[1] * ray[1]
        y = known[1] * ray[0] + known[4] * ray[1]
        height = max(self._height(known), 1e-300)
        lean = run.variance / (run.cosine * leaf.normal[2])
        return min(lean * sqrt(x * x + y * y) / height, TURNED)

    def _apart(self, leaf: Record, run: Record) -> cython.bint:
        """Whether a first plane is of places that lie farther apart along the ray than noise puts
        them: else it is turned towards the ray.

        A slope of variance v from heights whose mean has the variance h is of places of variance
        h (1 / v - 1 / v_0), v_0 that of a first estimate; a line that stands on one place seems to
        have that which noise moves its points by along the plane, var(e) |B^T u|^2 over their
        number.
        """
        ray = cython.declare(cython.double[2])
        self._along(leaf, run, ray)
        known = leaf.range_part
        flat = ray[0] * ray[0] + ray[1] * ray[1]
        slope = ray[0] * ray[0] * known[0] + 2.0 * ray[0] * ray[1] * known[1]
        slope += ray[1] * ray[1] * known[4]
        told = flat / max(slope, 1e-300) - 1.0 / (LEVEL_SIGMA * LEVEL_SIGMA)
        height = self._height(known)
        noise = run.variance / (run.cosine * run.cosine * run.points)
        return height * told >= APART * noise * flat

    def _divide(self, row: cython.Py_ssize_t, run: Record) -> cython.bint:
        """Divide a leaf above the finest level, if there is room.

        What the plane did not describe, its mean square residual, makes its height less certain to
        the children. Its slope is worth `slope_points` measurements that fill a child, which have
        the horizontal variance side^2 / 12.
        """
        leaf = self.table.at(row)
        if leaf.level >= self.table.max_level:
            return False
        square = run.variance
        if leaf.division_weight > 0.0:
            square = max(leaf.square_sum / leaf.division_weight, square)
        side = 0.5 * self.table.side(leaf.level)
        tilt = 12.0 * run.variance / (self.rules.slope_points * side * side)
        spread = standing_out(self.rules, leaf, run.variance)
        if not self.table.divide(row, square, min(tilt, 1.0), spread):
            self.refused += 1
            return False
        self.divisions += 1
        return True

    def _settle(
        self,
        row: cython.Py_ssize_t,
        begin: cython.Py_ssize_t,
        end: cython.Py_ssize_t,
        run: Record,
        same_scan: cython.bint,
    ) -> None:
        """Take a run of points into a leaf or its descendants.

        A strip that tells no plane of a fresh leaf waits while it grows from scan to scan, as where
        a scan comes in: the next shows more. Else it goes on in smaller leaves, which can hold what
        this one cannot. A view of a part of a leaf is held against the plane as it was: a rock that
        fills the view would bend it. The others are fused, judged and come to rest, or divide the
        leaf.
        """
        leaf = self.table.at(row)
        side = self.table.side(leaf.level)
        if self._contradicts(leaf, run):
            leaf.points -= run.points
            if leaf.points > 0.0:
                self._mark(begin, end, SEEN)
                return
            self.table.forget(leaf)
        fresh: cython.bint = leaf.known <= HINTS
        if fresh and run.sloped == 0.0:
            seen = 1.0 - run.unseen
            grows: cython.bint = seen > leaf.strip
            leaf.strip = max(leaf.strip, seen)
            enough: cython.bint = run.points >= self.rules.min_residuals
            if enough and not grows and self._divide(row, run):
                self._go_on(row, begin, end, False)
            else:
                self._mark(begin, end, SEEN)
            return
        if leaf.known >= INHERITED:
            self._doubt(leaf, run)
            if (
                partial(run)
                and leaf.level < self.table.max_level
                and departs(self.rules, leaf, run, self.points, begin, end, self.origin, side)
            ):
                self._residuals(leaf, begin, end, run)
                if self._divide(row, run):
                    self._go_on(row, begin, end, False)
                    return
        judge(self.rules, leaf, run, self.points, begin, end, self.origin, self.sigma)
        x, y, z = leaf.normal[0] / leaf.normal[2], leaf.normal[1] / leaf.normal[2], leaf.z
        self._fuse(leaf, run, same_scan)
        if not fabs(leaf.z) < HIGHEST:  # planes of places far above each other lead anywhere
            self.table.forget(leaf)
            self._mark(begin, end, SEEN)
            return
        moved = fabs(leaf.normal[0] / leaf.normal[2] - x) + fabs(
            leaf.normal[1] / leaf.normal[2] - y
        )
        most = MOVED * standing_out(self.rules, leaf, run.variance)
        if fabs(leaf.z - z) + 0.5 * side * moved > most:
            self.table.unknow(leaf)  # what was known, was by another plane
            leaf.low, leaf.high = INFINITE, -INFINITE
        if leaf.known != MEASURED:
            self._mark(begin, end, SEEN)
            return
        asked: cython.bint = asks(self.rules, leaf, run)
        if asked and leaf.level < self.table.max_level:
            self._residuals(leaf, begin, end, run)
        if not (asked and self._divide(row, run)):
            self._rest(leaf, begin, end, run)
            if asked or leaf.level == self.table.max_level:
                return
            mound: cython.bint = self._mound(begin, end, run.variance, 1.0)
            if not (mound or hides_rock(self.rules, leaf) or rough(self.rules, leaf)):
                return
            if not self._divide(row, run):
                return
            self._mound(begin, end, run.variance, -1.0)  # they are to come to rest once
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
        run = record(self.runs, self.cells + self.table.at(row).level)
        cython.declare(child=cython.Py_ssize_t, stop=cython.Py_ssize_t)
        while begin < end:
            child = self.table.over[self.key[begin]]
            stop = begin + 1
            while stop < end and self.table.over[self.key[stop]] == child:
                stop += 1
            self._measure(self.table.at(child), begin, stop, run)
            self._settle(child, begin, stop, run, same_scan)
            begin = stop

    @cython.boundscheck(False)
    def _mark(self, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, state: cython.uchar) -> None:
        """The finest cells under a run are `SEEN` at least, or `KNOWN`."""
        i: cython.Py_ssize_t
        for i in range(begin, end):
            if self.table.seen[self.key[i]] < state:
                self.table.seen[self.key[i]] = state

    @cython.boundscheck(False)
    def _residuals(
        self, leaf: Record, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, run: Record
    ) -> None:
        """A run held against a leaf's plane: what stands out, and where.

        Of each finest cell the last look decides, and in it more than `FEW` of the cell's returns:
        one of noise's tail among many does not last. One return alone, of few, is no evidence of
        either: the cell stays what it was.
        """
        cython.declare(i=cython.Py_ssize_t)
        out = count = 0.0
        rest(self.rules, leaf, run, self.points, self.residual, begin, end, self.origin)
        if run.greatest <= run.raised_by:
            know(self.table.seen, self.key, begin, end)
            return
        for i in range(begin, end):
            count += 1.0
            if fabs(self.residual[i]) > run.raised_by:
                out += 1.0
            if i == end - 1 or self.key[i + 1] != self.key[i]:
                if out <= FEW * count:
                    self.table.seen[self.key[i]] = KNOWN
                elif out > 1.0:
                    self.table.seen[self.key[i]] = OUT
                else:
                    self._mark(i, i + 1, SEEN)
                out = count = 0.0

    @cython.boundscheck(False)
    def _mound(
        self, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, variance: float, sign: float
    ) -> cython.bint:
        """Whether a finest cell rises over its leaf's plane as under a rock, by `MOUND`.

        What noise of ``variance`` v hides in each scan, the mean of n returns of all of them shows:
        it must rise by `PILED` sqrt(v / n), too. Those of this run are added, or with a ``sign`` of
        -1 taken away again.
        """
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
                found |= high and total * total > PILED * PILED * variance * count
                total = count = 0.0
        return found

    def _rest(
        self, leaf: Record, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, run: Record
    ) -> None:
        """Points came to rest: residuals, and the leaf's feature."""
        if run.points >= NOISE_POINTS:
            self.ratios[self.rested] = sqrt(run.square / run.variance)
            self.weights[self.rested] = run.points
            self.rested += 1
        self._residuals(leaf, begin, end, run)
        update_feature(
            self.rules,
            leaf,
            self.points,
            self.residual,
            begin,
            end,
            leaf.x - self.origin[0],
            leaf.y - self.origin[1],
            self.table.side(leaf.level),
            run.variance,
            run.greatest,
            self.room.heights,
        )
