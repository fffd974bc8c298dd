# SPDX-License-Identifier: Apache-2.0
"""What one scan does to the leaves: fit, fuse, judge, divide, come to rest (paper IV)."""

from __future__ import annotations

from typing import Any

import cython
import numpy as np
from cython.cimports.libc.math import INFINITY, fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry.plane import offset_variance
from cython.cimports.quadtree_lss.onboard.core.mapping import division, measure
from cython.cimports.quadtree_lss.onboard.core.mapping import update as row
from cython.cimports.quadtree_lss.onboard.core.mapping.division import departs, hides_rock, judge
from cython.cimports.quadtree_lss.onboard.core.mapping.features import update_feature
from cython.cimports.quadtree_lss.onboard.core.mapping.update import OF_MAP as OF_MAP
from cython.cimports.quadtree_lss.onboard.core.mapping.update import OF_SCAN as OF_SCAN
from cython.cimports.quadtree_lss.onboard.core.mapping.update import OWN as OWN
from cython.cimports.quadtree_lss.onboard.core.mapping.update import RISE as RISE
from cython.cimports.quadtree_lss.onboard.core.tree import leaves

from quadtree_lss.onboard.arrays import Array, Bytes, Keys
from quadtree_lss.onboard.core.geometry.bounds import HEIGHTS
from quadtree_lss.onboard.core.mapping.features import Heights
from quadtree_lss.onboard.core.mapping.fusion import Fusion
from quadtree_lss.onboard.core.mapping.measure import RUN, Rules
from quadtree_lss.onboard.core.sensing.register import KEPT_POINTS, RegisteredScan
from quadtree_lss.onboard.core.tree.leaves import LeafTable, Record

#: Share of a finest cell, of 6 cm in 25, on which nothing stands out that matters.
FEW = cython.declare(cython.double, 1.0 / 16.0)
#: A plane that moved by such a share of what stands out is another one.
MOVED = cython.declare(cython.double, 0.75)
#: The mean of a finest cell's returns rises so many deviations over a plane: of 65,536 cells noise
#: lifts two so far.
PILED = cython.declare(cython.double, 4.0)
#: Of the mean square that a plane leaves out, what planes half as wide leave out: residuals go with
#: the width.
LESS = cython.declare(cython.double, 0.25)
#: Points of a scan in a cell that tell the range noise, and the least z of its normal (30 degrees
#: of slope): facades and trees tell nothing.
NOISE_POINTS = cython.declare(cython.double, 8.0)
LEVEL = cython.declare(cython.double, 0.866)
#: A plane is higher or lower at no cell's centre, m.
HIGHEST = cython.declare(cython.double, HEIGHTS)


@cython.boundscheck(False)
def put(
    seen: Bytes, key: Keys, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, state: cython.uchar
) -> None:
    """Set the state of the finest cells under the points ``begin`` to ``end`` of keys (N,)."""
    i: cython.Py_ssize_t
    for i in range(begin, end):
        seen[key[i]] = state


class Room:
    """Memory for what is found of one scan, kept for the next: its points and its cells.

    To ask for it anew and to tell what its records are took a twentieth of a scan. What was in it
    is lost as it grows.

    Attributes:
        begins, rows: Of each cell, the first of its points, and its row in the table.
        residual: Of each point, m.
        ratio: (2, N) of cells that tell the range noise.
        heights: For the feature of a cell.
        runs: Records of type `RUN`, one for each cell.
    """

    def __init__(self) -> None:
        self.points = self.cells = -1

    def hold(self, points: cython.Py_ssize_t) -> None:
        """Have room for so many points."""
        if points > self.points:
            self.points = points
            self.begins, self.rows = np.empty((2, points + 1), dtype=np.intp)
            self.residual = np.empty(points)
            self.ratio = np.empty((2, points))
            self.ratios, self.weights = self.ratio
            self.heights = Heights(points)

    def hold_runs(self, cells: cython.Py_ssize_t) -> None:
        """Have room for the records of so many cells."""
        if cells > self.cells:
            self.cells = 2 * cells
            self.runs = np.empty(self.cells, dtype=RUN)


class ScanUpdate:
    """One scan on its way through the leaves.

    Points lie about the lidar, in Morton order, so that those of a cell of any level are one run.

    Attributes:
        cells: Leaves that the scan touches.
        estimated, compared: Points in leaves with a plane of their own, and in those of them that
            `fit` compares.
        divisions, refused: Cells divided, and divisions for which there was no room.
        ratio: (2, R) of the cells in which points came to rest and that tell the range noise:
            observed over configured deviation, and points; until the next scan.
    """

    def __init__(
        self,
        table: LeafTable,
        rules: Rules,
        scan: RegisteredScan,
        now: float,
        room: Room | None = None,
    ) -> None:
        count = len(scan.key)
        self.table = table
        self.fusion = Fusion(rules, scan, now)
        self.rules = rules
        rules.look(scan.pose.rotation_map_lidar[:, 2])
        self.points = scan.points
        self.key = scan.key
        self.room = Room() if room is None or count > KEPT_POINTS else room
        self.room.hold(count)
        self.residual = self.room.residual
        self.divisions = self.refused = self.rested = self.estimated = self.compared = 0
        self._gather()

    @cython.boundscheck(False)
    def _gather(self) -> None:
        """Find the runs of points that share a leaf: in steps that double until one leads out of
        it, and then halve."""
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

    @cython.boundscheck(False)
    def _run(self, at: cython.Py_ssize_t) -> Record:
        """One record of type `measure.RUN`, to read and to write."""
        return cython.address(self.runs[at])

    @cython.boundscheck(False)
    def _leaf(self, row: cython.Py_ssize_t) -> Record:
        """One leaf, to read and to write."""
        return cython.address(self.table.leaf[row])

    @cython.boundscheck(False)
    def _from(self, begin: cython.Py_ssize_t) -> Any:
        """Points from one on, x, y and z of one after the other."""
        return cython.address(self.points[begin, 0])

    @cython.boundscheck(False)
    def _residual_from(self, begin: cython.Py_ssize_t) -> Any:
        """Residuals of the points from one on."""
        return cython.address(self.residual[begin])

    @cython.boundscheck(False)
    def fit(self) -> Array:
        """Fit the touched leaves; the scan beside the map in the M that were measured before.

        Where there is no plane to compare with, `settle` fits, while the leaf is near for more.
        Leaves divided from rough ground (tree crowns) are not compared: their planes depend on
        which returns a scan happens to have, not on its pose.

        Returns:
            (ROWS, M), by row. `RISE`: scan's height over the map, m; `OWN`: variance of that but
            for pose error, m^2. `OF_SCAN`, `OF_MAP`: variance of the height of either from pose
            error, m^2. `FIRST_TIME`, `LAST_TIME`: of the scans in the map's plane, s. `PLACE_X`,
            `PLACE_Y`, `PLACE_Z`: of the cell about the lidar, m. `SLOPE_X`, `SLOPE_Y`: the map's,
            and `OF_SLOPE`: variance of either from pose error.
        """
        i: cython.Py_ssize_t
        found: cython.Py_ssize_t = 0
        out = np.empty((row.ROWS, self.cells))
        self.columns = out
        with cython.nogil:
            for i in range(self.cells):
                self.table.glance(self.rows[min(i + 16, self.cells - 1)])
                leaf = self._leaf(self.rows[i])
                if leaf.known <= leaves.HINTS:
                    self._level(leaf)
                    continue
                self.table.expect(self.rows[min(i + 4, self.cells - 1)])
                run = self._run(i)
                self._measure(leaf, self.begins[i], self.begins[i + 1], run)
                if leaf.known == leaves.MEASURED:
                    self.estimated += self.begins[i + 1] - self.begins[i]
                if self._comparable(leaf):
                    self.compared += self.begins[i + 1] - self.begins[i]
                    self._compare(leaf, run, found)
                    found += 1
        return out[:, :found]

    @cython.boundscheck(False)
    def parts(self) -> Array:
        """`RISE` to `OF_MAP`, (4, M), of the finest cells that were known, each by its mean."""
        cython.declare(i=cython.Py_ssize_t, k=cython.Py_ssize_t)
        found: cython.Py_ssize_t = 0
        out = np.empty((4, len(self.key)))
        self.columns = out
        for i in range(self.cells):
            leaf = self._leaf(self.rows[i])
            if not self._comparable(leaf):
                continue
            run = self._run(i)
            up = leaf.normal[2]
            x = leaf.x - self.fusion.origin[0]
            y = leaf.y - self.fusion.origin[1]
            z = leaf.z - self.fusion.origin[2]
            misfit = leaf.square_sum / max(leaf.division_weight, 1.0) - run.variance
            along_x = leaf.normal[0] / up
            along_y = leaf.normal[1] / up
            total = count = 0.0
            for k in range(self.begins[i], self.begins[i + 1]):
                total += self.points[k, 2] - z
                total += along_x * (self.points[k, 0] - x) + along_y * (self.points[k, 1] - y)
                count += 1.0
                if k + 1 == self.begins[i + 1] or self.key[k + 1] != self.key[k]:
                    if self.table.seen[self.key[k]] == leaves.KNOWN:
                        own = run.variance / count + leaf.range_part[8]
                        self.columns[row.RISE, found] = total / count
                        self.columns[row.OWN, found] = own / (up * up) + max(misfit, 0.0)
                        self.columns[row.OF_SCAN, found] = run.pose_part[8] / (up * up)
                        self.columns[row.OF_MAP, found] = leaf.pose_part[8] / (up * up)
                        found += 1
                    total = count = 0.0
        return out[:, :found]

    def _comparable(self, leaf: Record) -> cython.bint:
        """Whether the height of a scan over a leaf tells the scan's offset from the map."""
        return leaf.known == leaves.MEASURED and leaf.uneven <= self.rules.slack

    def _compare(self, leaf: Record, run: Record, at: cython.Py_ssize_t) -> None:
        """One column of what `fit` returns; few points are compared where they lie, for what they
        say of the cell's centre is the slope that the map has."""
        place = cython.declare(cython.double[3])
        square = leaf.normal[2] * leaf.normal[2]
        own = run.range_part[8] + leaf.range_part[8]
        misfit = leaf.square_sum / max(leaf.division_weight, 1.0) - run.variance
        self.columns[row.RISE, at] = run.z + self.fusion.origin[2] - leaf.z
        if measure.few(run):
            self.fusion.place(leaf, run, place)
            own = run.variance / run.points + offset_variance(leaf.range_part, place[0], place[1])
            self.columns[row.RISE, at] = place[2]
        seen = max(1.0 - run.unseen, 0.1)
        own += self.rules.uneven * (1.0 / (seen * seen) - 1.0)
        self.columns[row.OWN, at] = own / square + max(misfit, 0.0)
        pose = run.pose_part[8]
        if self.rules.independent:  # no part of a plane, but of the scan
            pose = measure.pose_variance(leaf.normal, run.centroid, self.fusion.sigma)
        self.columns[row.OF_SCAN, at] = pose / square
        self.columns[row.OF_MAP, at] = leaf.pose_part[8] / square
        self.columns[row.FIRST_TIME, at] = leaf.first_time
        self.columns[row.LAST_TIME, at] = leaf.last_time
        self.columns[row.PLACE_X, at] = leaf.x - self.fusion.origin[0]
        self.columns[row.PLACE_Y, at] = leaf.y - self.fusion.origin[1]
        self.columns[row.PLACE_Z, at] = run.z
        self.columns[row.SLOPE_X, at] = -leaf.normal[0] / leaf.normal[2]
        self.columns[row.SLOPE_Y, at] = -leaf.normal[1] / leaf.normal[2]
        tilt = 0.5 * (leaf.pose_part[0] + leaf.pose_part[4])
        self.columns[row.OF_SLOPE, at] = tilt / (square * square)

    def align(self, down: float) -> None:
        """Lower the scan to where the map lies, by so many m."""
        self.fusion.align(down)

    @cython.boundscheck(False)
    def settle(self) -> None:
        """Fuse, judge and divide until no cell asks for it; then count the residuals."""
        cython.declare(i=cython.Py_ssize_t, begin=cython.Py_ssize_t, end=cython.Py_ssize_t)
        cython.declare(levels=cython.Py_ssize_t)
        self.ratios, self.weights = self.room.ratios, self.room.weights
        with cython.nogil:
            for i in range(self.cells):
                self.table.expect(self.rows[min(i + 4, self.cells - 1)])
                begin, end = self.begins[i], self.begins[i + 1]
                leaf, run = self._leaf(self.rows[i]), self._run(i)
                if leaf.known <= leaves.HINTS:
                    run = self._run(self.cells)
                    self._measure(leaf, begin, end, run)
                levels = self.table.max_level - leaf.level
                if levels > 0:
                    levels = min(3 * levels * (end - begin), (1 << (2 * levels)) - 1)
                    if self.table.count + levels > self.table.capacity:
                        with cython.gil:
                            self.table.reserve(levels)
                self._settle(self.rows[i], begin, end, run, False)
        self.ratio = self.room.ratio[:, : self.rested]

    def _level(self, leaf: Record) -> None:
        """Where nothing is known, ground is taken to be level."""
        if leaf.known == leaves.NOTHING:
            leaf.normal[0] = leaf.normal[1] = 0.0
            leaf.normal[2] = 1.0

    def _measure(
        self, leaf: Record, begin: cython.Py_ssize_t, end: cython.Py_ssize_t, run: Record
    ) -> None:
        """Fit a run of points in a leaf."""
        points, side = self._from(begin), self.table.sides[leaf.level]
        origin, sigma = self.fusion.origin, self.fusion.sigma
        measure.measure(self.rules, leaf, run, points, end - begin, origin, sigma, side)

    def _divide(self, row: cython.Py_ssize_t, run: Record) -> cython.bint:
        """Divide a leaf above the finest level, if there is room.

        What the plane did not describe, its mean square residual, makes its height less certain to
        the children. Its slope is worth `slope_points` measurements that fill a child, which have
        the horizontal variance side^2 / 12; what is `left_out` counts twice, for neighbours have
        it in common. Points of a child may be too few to show it and have it all the same.
        """
        leaf = self._leaf(row)
        if leaf.level >= self.table.max_level:
            return False
        square = run.variance
        if leaf.division_weight > 0.0:
            square = max(leaf.square_sum / leaf.division_weight, square)
        uneven = max(division.left_out(leaf, run.variance), leaf.uneven)
        side = 0.5 * self.table.side(leaf.level)
        tilt = run.variance + 2.0 * uneven
        tilt *= 12.0 / (self.rules.slope_points * side * side)
        spread = division.standing_out(self.rules, leaf, run.variance)
        if not self.table.divide(row, square, tilt, spread, LESS * uneven):
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
        leaf = self._leaf(row)
        side = self.table.sides[leaf.level]
        if self.fusion.contradicts(leaf, run):
            leaf.points -= run.points
            if leaf.points > 0.0:
                if run.points > 1.0:  # one return alone is no evidence
                    put(self.table.seen, self.key, begin, end, leaves.SEEN)
                else:
                    self._mark(begin, end, leaves.SEEN)
                return
            self.table.forget(leaf)
            self._measure(leaf, begin, end, run)
        fresh: cython.bint = leaf.known <= leaves.HINTS
        if fresh and run.sloped == 0.0:
            seen = 1.0 - run.unseen
            grows: cython.bint = seen > leaf.strip
            leaf.strip = max(leaf.strip, seen)
            enough: cython.bint = run.points >= self.rules.min_residuals
            if enough and not grows and self._divide(row, run):
                self._go_on(row, begin, end, False)
            else:
                self._mark(begin, end, leaves.SEEN)
            return
        if leaf.known >= leaves.INHERITED:
            self.fusion.doubt(leaf, run)
            if (
                measure.partial(run)
                and leaf.level < self.table.max_level
                and departs(self.rules, leaf, run, self._from(begin), self.fusion.origin, side)
            ):
                self._residuals(leaf, begin, end, run)
                if self._divide(row, run):
                    self._go_on(row, begin, end, False)
                    return
        if not measure.few(run):
            judge(self.rules, leaf, run, self._from(begin), self.fusion.origin, self.fusion.sigma)
        x, y, z, up = leaf.normal[0], leaf.normal[1], leaf.z, leaf.normal[2]
        self.fusion.fuse(leaf, run, same_scan)
        if not fabs(leaf.z) < HIGHEST:  # planes of places far above each other lead anywhere
            self.table.forget(leaf)
            self._mark(begin, end, leaves.SEEN)
            return
        if not fresh:  # by no plane was anything known
            moved = fabs(leaf.normal[0] / leaf.normal[2] - x / up)
            moved += fabs(leaf.normal[1] / leaf.normal[2] - y / up)
            most = MOVED * division.standing_out(self.rules, leaf, run.variance)
            if fabs(leaf.z - z) + 0.5 * side * moved > most:
                turn_x = x / up - leaf.normal[0] / leaf.normal[2]
                turn_y = y / up - leaf.normal[1] / leaf.normal[2]
                if not self.table.unmark_moved(leaf, leaf.z - z, turn_x, turn_y, most):
                    leaf.low, leaf.high = INFINITY, -INFINITY
        if leaf.known != leaves.MEASURED:
            self._mark(begin, end, leaves.SEEN)
            return
        asked: cython.bint = division.asks(self.rules, leaf, run)
        if asked and leaf.level < self.table.max_level:
            self._residuals(leaf, begin, end, run)
        if not (asked and self._divide(row, run)):
            self._rest(leaf, begin, end, run)
            if asked or leaf.level == self.table.max_level:
                return
            mound: cython.bint = self._mound(begin, end, run.variance, 1.0)
            if not (mound or hides_rock(self.rules, leaf) or division.rough(self.rules, leaf)):
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
        run = self._run(self.cells + self._leaf(row).level)
        cython.declare(child=cython.Py_ssize_t, stop=cython.Py_ssize_t)
        while begin < end:
            child = self.table.over[self.key[begin]]
            stop = begin + 1
            while stop < end and self.table.over[self.key[stop]] == child:
                stop += 1
            leaf = self._leaf(child)
            self._level(leaf)
            self._measure(leaf, begin, stop, run)
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
    def _record_hits(self, begin: cython.Py_ssize_t, end: cython.Py_ssize_t) -> None:
        """Record in which of the 4 x 4 parts of their finest cells the points of a run fell."""
        cython.declare(i=cython.Py_ssize_t, column=cython.int, line=cython.int)
        per = 4.0 / self.table.sides[self.table.max_level]
        x = (self.fusion.origin[0] - self.table.xmin) * per
        y = (self.fusion.origin[1] - self.table.ymin) * per
        for i in range(begin, end):
            if self.table.hits[self.key[i]] == 0xFFFF:
                continue
            column = cython.cast(cython.int, self.points[i, 0] * per + x)
            line = cython.cast(cython.int, self.points[i, 1] * per + y)
            self.table.hits[self.key[i]] |= 1 << ((column & 3) | (line & 3) << 2)

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
        self._record_hits(begin, end)
        points, residual = self._from(begin), self._residual_from(begin)
        division.rest(self.rules, leaf, run, points, residual, self.fusion.origin)
        if run.greatest <= run.raised_by:
            put(self.table.seen, self.key, begin, end, leaves.KNOWN)
            return
        for i in range(begin, end):
            count += 1.0
            if fabs(self.residual[i]) > run.raised_by:
                out += 1.0
            if i == end - 1 or self.key[i + 1] != self.key[i]:
                if out <= FEW * count:
                    self.table.seen[self.key[i]] = leaves.KNOWN
                elif out > 1.0:
                    self.table.seen[self.key[i]] = leaves.OUT
                else:
                    self._mark(i, i + 1, leaves.SEEN)
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
        if run.points >= NOISE_POINTS and leaf.normal[2] >= LEVEL:
            self.ratios[self.rested] = sqrt(run.square / run.variance)
            self.weights[self.rested] = run.points
            self.rested += 1
        self._residuals(leaf, begin, end, run)
        points, residual = self._from(begin), self._residual_from(begin)
        origin, side = self.fusion.origin, self.table.sides[leaf.level]
        update_feature(self.rules, leaf, run, points, residual, origin, side, self.room.heights)
