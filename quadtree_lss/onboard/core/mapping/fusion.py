# SPDX-License-Identifier: Apache-2.0
"""What a leaf knew and what a scan says of it made one (paper IV.C); how far they may differ."""

from __future__ import annotations

import cython
from cython.cimports.libc.math import exp, fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry import plane as planes
from cython.cimports.quadtree_lss.onboard.core.geometry.plane import fuse, fuse_height
from cython.cimports.quadtree_lss.onboard.core.geometry.sphere import basis_at
from cython.cimports.quadtree_lss.onboard.core.mapping.measure import pose_variance
from cython.cimports.quadtree_lss.onboard.core.tree import leaves
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import LIFT, WEIGHT

from quadtree_lss.onboard.core.geometry.sphere import Vector
from quadtree_lss.onboard.core.mapping.measure import Rules
from quadtree_lss.onboard.core.sensing.register import RegisteredScan
from quadtree_lss.onboard.core.tree.leaves import Record

#: Before anything is known, ground is level but for this (rad, one sigma) ...
LEVEL_SIGMA = cython.declare(cython.double, 0.5)
#: ... and this high or low, m.
HEIGHT_SIGMA = cython.declare(cython.double, 1e3)
#: Variance of the places of a first plane along the ray, over that of noise, at least.
APART = cython.declare(cython.double, 4.0)
#: Noise turns no plane by more, rad.
TURNED = cython.declare(cython.double, 1.5)
#: A run contradicts a plane that is so many deviations off.
CONTRADICTING = cython.declare(cython.double, 30.0)


class Fusion:
    """One scan's fits and what leaves knew.

    Attributes:
        origin: (3) of the lidar, map frame, m; lowered by `align`.
        sigma: (36) covariance of the scan's pose.
        aligned: Whether the scan was brought to the height of the map.
        now: Time of the scan, s.
    """

    def __init__(self, rules: Rules, scan: RegisteredScan, now: float) -> None:
        self.rules = rules
        x, y, z = scan.origin.tolist()
        self.origin = [x, y, z]
        covariance = scan.pose.covariance.ravel().tolist()
        self.sigma = [0.0] * 36
        for i in range(36):
            self.sigma[i] = covariance[i]
        self.aligned = False
        self.now = self.common_at = now
        self.common_is = 1.0

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

    def contradicts(self, leaf: Record, run: Record) -> cython.bint:
        """Whether a run is of another place altogether than a plane, beyond any covariance.

        A scan with a wrong pose over ground that no other had seen leaves such planes; to average
        with them would keep them for ever. They are kept apart, and points are votes.
        """
        if leaf.known < leaves.INHERITED:
            return False
        variance = leaf.range_part[8] + leaf.pose_part[8] + run.range_part[8] + run.pose_part[8]
        off = (leaf.z - self.origin[2] - run.z) * leaf.normal[2]
        return off * off > CONTRADICTING * CONTRADICTING * (variance + self.rules.slack)

    def place(self, leaf: Record, run: Record, out: Vector) -> None:
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

    def doubt(self, leaf: Record, run: Record) -> None:
        """How far a run may lie off a leaf's plane where it was seen and both be right, m.

        Twice the deviation: of the plane at the run's place, of the run, of what a plane leaves
        out that passes for one, and what is news of the pose's error. Its height is taken out
        where the scan was aligned. Besides, the share of its offset that is the plane's and the
        pose's, p / (p + v / N) with their variance p and that of noise v.
        """
        place = cython.declare(cython.double[3])
        self.place(leaf, run, place)
        first, second = place[0], place[1]
        factor = self.rules.division_factor
        own = run.variance * (1.0 / run.points + factor * factor - 1.0)
        news = 1.0 - self.common(leaf.last_time)
        known = planes.offset_variance(leaf.pose_part, first, second)
        # That of the pose's height, z.
        high = leaf.normal[2] * leaf.normal[2] * self.sigma[14] if self.aligned else 0.0
        plane = planes.offset_variance(leaf.range_part, first, second)
        run.doubt = 2.0 * sqrt(own + plane + news * max(known + run.pose_part[8] - 2.0 * high, 0.0))
        plane += news * (known + max(run.pose_part[8] - high, 0.0))
        run.shared = plane / (plane + run.variance / run.points)

    def fuse(self, leaf: Record, run: Record, same_scan: cython.bint) -> None:
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
        fresh: cython.bint = leaf.known <= leaves.HINTS
        if leaf.known == leaves.NOTHING:
            leaf.first_time = self.now
            leaf.z = run.z + self.origin[2]
            for i in range(9):
                leaf.range_part[i] = leaf.pose_part[i] = 0.0
            leaf.range_part[0] = leaf.range_part[4] = LEVEL_SIGMA * LEVEL_SIGMA
            leaf.range_part[8] = HEIGHT_SIGMA * HEIGHT_SIGMA
        if same_scan or (self.aligned and leaf.known == leaves.INHERITED):
            common = 1.0
            if not same_scan:
                sideways[0], sideways[1], sideways[2] = run.normal[0], run.normal[1], 0.0
                news = 1.0 - self.common(leaf.last_time)
                news *= pose_variance(sideways, run.centroid, self.sigma)
                run.range_part[8] += news
                run.own += news
            for i in range(9):
                run.pose_part[i] = leaf.pose_part[i]
        else:
            common = self.common(leaf.last_time)
        if leaf.known == leaves.INHERITED:
            # An inherited slope counts as a fit as certain as it.
            leaf.bias[WEIGHT] = run.variance / (leaf.range_part[0] + leaf.range_part[4])
        ranges, poses = leaf.range_part, leaf.pose_part
        off = leaf.z - self.origin[2] - run.z
        if run.alone:
            place, pose = run.lever, run.pose_part
            sloped: cython.bint = run.sloped > 0.0
            fuse_height(leaf.normal, off, ranges, poses, place, run.own, pose, common, sloped, rise)
        else:
            of_range, of_pose = run.range_part, run.pose_part
            fuse(leaf.normal, off, ranges, poses, run.normal, of_range, of_pose, common, rise)
            for i in range(3):
                leaf.normal[i] = run.normal[i]
        leaf.z = run.z + self.origin[2] + rise[0]
        leaf.points += run.points
        leaf.bias[WEIGHT] += run.bias[WEIGHT]
        if run.bias[WEIGHT] > 0.0:
            share = run.bias[WEIGHT] / max(leaf.bias[WEIGHT], 1e-300)
            for i in range(3):
                leaf.bias[i] += share * (run.bias[i] - leaf.bias[i])
        leaf.bias[LIFT] += run.points / leaf.points * (run.bias[LIFT] - leaf.bias[LIFT])
        leaf.last_time = self.now
        if fresh:
            steep = leaf.range_part[0] + leaf.range_part[4]
            few: cython.bint = leaf.points < self.rules.min_points
            if few or steep > leaves.NO_SLOPE or not self._apart(leaf, run):
                leaf.known = leaves.HINTS
                return
        if leaf.bias[WEIGHT] == 0.0:
            self._turn(leaf, run)
        leaf.known = leaves.MEASURED

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

    def _turn(self, leaf: Record, run: Record) -> None:
        """What noise along the ray may turn a plane by of which lines of points alone tell.

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
        lean = run.variance / (run.cosine * leaf.normal[2] * height)
        lean *= min(1.0, TURNED / max(lean * sqrt(x * x + y * y), 1e-300))
        lean *= lean
        leaf.bias[0] = lean * x * x
        leaf.bias[1] = lean * x * y
        leaf.bias[2] = lean * y * y

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
        sure = flat / max(slope, 1e-300) - 1.0 / (LEVEL_SIGMA * LEVEL_SIGMA)
        height = self._height(known)
        noise = run.variance / (run.cosine * run.cosine * run.points)
        return height * sure >= APART * noise * flat
