# SPDX-License-Identifier: Apache-2.0
"""Fusion of a scan's fit with the plane of a leaf (paper IV.C), and limits of their difference."""

from __future__ import annotations

import cython
from cython.cimports.libc.math import exp, fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry import plane as planes
from cython.cimports.quadtree_lss.onboard.core.geometry.plane import fuse, fuse_height
from cython.cimports.quadtree_lss.onboard.core.geometry.sphere import basis_at
from cython.cimports.quadtree_lss.onboard.core.mapping.measure import FIT_POINTS, pose_variance
from cython.cimports.quadtree_lss.onboard.core.tree import leaves
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import LIFT, WEIGHT

from quadtree_lss.onboard.core.geometry.sphere import Vector
from quadtree_lss.onboard.core.mapping.measure import Rules
from quadtree_lss.onboard.core.sensing.register import RegisteredScan
from quadtree_lss.onboard.core.tree.leaves import Record

#: Standard deviation of the slope before the first scan, rad, ...
LEVEL_SIGMA = cython.declare(cython.double, 0.5)
#: ... and of the height, m.
HEIGHT_SIGMA = cython.declare(cython.double, 1e3)
#: Least variance of the places of a first plane along the ray, over that of noise.
MIN_SPREAD = cython.declare(cython.double, 4.0)
#: Greatest turn of a plane by noise, rad.
MAX_TURN = cython.declare(cython.double, 1.5)
#: Standard deviations beyond which a run and a plane are not the same ground.
ELSEWHERE_SIGMAS = cython.declare(cython.double, 30.0)


class Fusion:
    """Fusion of one scan's fits with the leaves: its ``pose``; ``aligned``: whether the scan was
    shifted to the height of the map; ``now``, s."""

    def __init__(self, rules: Rules, scan: RegisteredScan, now: float) -> None:
        self.rules = rules
        pose, ahead = scan.pose, scan.pose.rotation_map_lidar[:, 2]
        self.pose: Record = {
            "origin": pose.position.tolist(),
            "sigma": pose.covariance.ravel().tolist(),
            "boresight": ahead.tolist(),
        }
        self.aligned = False
        self.now = self.correlation_at = now
        self.correlation_is = 1.0

    def correlation(self, time: float) -> cython.double:
        """Return the correlation of this scan's pose error with that of another time, s."""
        if self.rules.correlation_time <= 0.0:
            return 0.0
        if time != self.correlation_at:  # many leaves were last seen by the same scan
            self.correlation_at = time
            self.correlation_is = exp(-fabs(self.now - time) / self.rules.correlation_time)
        return self.correlation_is

    def is_elsewhere(self, leaf: Record, run: Record) -> cython.bint:
        """Return whether a run is so far from the plane that no covariance explains it, as after a
        scan with a wrong pose."""
        if leaf.state < leaves.INHERITED:
            return False
        variance = leaf.range_part[8] + leaf.pose_part[8] + run.range_part[8] + run.pose_part[8]
        off = (leaf.z - self.pose.origin[2] - run.z) * leaf.normal[2]
        return off * off > ELSEWHERE_SIGMAS * ELSEWHERE_SIGMAS * (variance + self.rules.slack)

    def offset_at(self, leaf: Record, run: Record, out: Vector) -> None:
        """Compute the place of a run's centroid along a plane's tangent axes, and its height over
        the plane there: (3), m."""
        basis = cython.declare(cython.double[6])
        basis_at(leaf.normal, basis)
        x = run.centroid[0] - (leaf.x - self.pose.origin[0])
        y = run.centroid[1] - (leaf.y - self.pose.origin[1])
        z = -(leaf.normal[0] * x + leaf.normal[1] * y) / leaf.normal[2]
        out[0] = basis[0] * x + basis[1] * y + basis[2] * z
        out[1] = basis[3] * x + basis[4] * y + basis[5] * z
        out[2] = run.centroid[2] - z - (leaf.z - self.pose.origin[2])

    def limit_offset(self, leaf: Record, run: Record) -> None:
        """Set the greatest plausible offset of a run from a leaf's plane, m, and its common share:
        two standard deviations of the plane at the run's place, the run, a tolerated misfit and the
        part of pose error that is not common, without its height if the scan is aligned; and
        p / (p + v / N) for the variance p of plane and pose and that of noise, v."""
        place = cython.declare(cython.double[3])
        self.offset_at(leaf, run, place)
        first, second = place[0], place[1]
        factor = self.rules.division_factor
        own = run.variance * (1.0 / run.points + factor * factor - 1.0)
        news = 1.0 - self.correlation(leaf.last_time)
        known = planes.offset_variance(leaf.pose_part, first, second)
        # That of the pose's height, z.
        high = leaf.normal[2] * leaf.normal[2] * self.pose.sigma[14] if self.aligned else 0.0
        plane = planes.offset_variance(leaf.range_part, first, second)
        run.offset_limit = 2.0 * sqrt(
            own + plane + news * max(known + run.pose_part[8] - 2.0 * high, 0.0)
        )
        plane += news * (known + max(run.pose_part[8] - high, 0.0))
        run.common_share = plane / (plane + run.variance / run.points)

    def fuse(self, leaf: Record, run: Record, same_scan: cython.bint) -> None:
        """Fuse a run's fit with the plane of a leaf (paper IV.C), at first level ground of great
        variance.

        Pose error is common to both if the plane was inherited in this scan or the scan is aligned
        to the map, except the sideways error of an aligned scan, which changes heights on slopes.
        """
        prior = cython.declare(planes.PlaneParts)
        measured = cython.declare(planes.PlaneParts)
        sideways = cython.declare(cython.double[3])
        i: cython.int
        fresh: cython.bint = leaf.state <= leaves.INCOMPLETE
        if leaf.state == leaves.UNKNOWN:
            leaf.first_time = self.now
            leaf.z = run.z + self.pose.origin[2]
            for i in range(9):
                leaf.range_part[i] = leaf.pose_part[i] = 0.0
            leaf.range_part[0] = leaf.range_part[4] = LEVEL_SIGMA * LEVEL_SIGMA
            leaf.range_part[8] = HEIGHT_SIGMA * HEIGHT_SIGMA
        if same_scan or (self.aligned and leaf.state == leaves.INHERITED):
            common = 1.0
            if not same_scan:
                sideways[0], sideways[1], sideways[2] = run.normal[0], run.normal[1], 0.0
                news = 1.0 - self.correlation(leaf.last_time)
                news *= pose_variance(sideways, run.centroid, self.pose.sigma)
                run.range_part[8] += news
                run.mean_variance += news
            for i in range(9):
                run.pose_part[i] = leaf.pose_part[i]
        else:
            common = self.correlation(leaf.last_time)
        if leaf.state == leaves.INHERITED:
            # An inherited slope counts as a fit as certain as it.
            leaf.bias[WEIGHT] = run.variance / (leaf.range_part[0] + leaf.range_part[4])
        prior.normal = leaf.normal
        prior.range_part, prior.pose_part = leaf.range_part, leaf.pose_part
        off = leaf.z - self.pose.origin[2] - run.z
        if run.height_only:
            sloped: cython.bint = run.has_slope > 0.0
            lever, variance, pose = run.lever, run.mean_variance, run.pose_part
            rise = fuse_height(cython.address(prior), off, lever, variance, pose, common, sloped)
        else:
            measured.normal, measured.range_part = run.normal, run.range_part
            measured.pose_part = run.pose_part
            rise = fuse(cython.address(prior), off, cython.address(measured), common)
        leaf.z = run.z + self.pose.origin[2] + rise
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
            few: cython.bint = leaf.points < FIT_POINTS
            if few or steep > leaves.NO_SLOPE or not self._is_spread(leaf, run):
                leaf.state = leaves.INCOMPLETE
                return
        if leaf.bias[WEIGHT] == 0.0:
            self._set_line_bias(leaf, run)
        leaf.state = leaves.ESTIMATED

    def _ray_in_plane(self, leaf: Record, run: Record, out: Vector) -> None:
        """Compute the unit ray to a run along the tangent axes of a leaf's plane (2)."""
        basis = cython.declare(cython.double[6])
        basis_at(leaf.normal, basis)
        x, y, z = run.centroid[0], run.centroid[1], run.centroid[2]
        per = 1.0 / sqrt(x * x + y * y + z * z)
        out[0] = per * (basis[0] * x + basis[1] * y + basis[2] * z)
        out[1] = per * (basis[3] * x + basis[4] * y + basis[5] * z)

    def _height_variance(self, known: Vector) -> cython.double:
        """Return the variance of a plane's height at the centroid of its points, m^2."""
        x = known[4] * known[2] - known[1] * known[5]
        y = known[0] * known[5] - known[1] * known[2]
        share = 1.0 / max(known[0] * known[4] - known[1] * known[1], 1e-300)
        return known[8] - share * (x * known[2] + y * known[5])

    def _set_line_bias(self, leaf: Record, run: Record) -> None:
        """Set the bias of a plane that only lines of points determine, as of a fit
        (`measure._bias`): A^-1 = V / h, with the covariance V of its slope and the variance h of
        its height."""
        ray = cython.declare(cython.double[2])
        self._ray_in_plane(leaf, run, ray)
        known = leaf.range_part
        x = known[0] * ray[0] + known[1] * ray[1]
        y = known[1] * ray[0] + known[4] * ray[1]
        height = max(self._height_variance(known), 1e-300)
        lean = run.variance / (run.cosine * leaf.normal[2] * height)
        lean *= min(1.0, MAX_TURN / max(lean * sqrt(x * x + y * y), 1e-300))
        lean *= lean
        leaf.bias[0] = lean * x * x
        leaf.bias[1] = lean * x * y
        leaf.bias[2] = lean * y * y

    def _is_spread(self, leaf: Record, run: Record) -> cython.bint:
        """Return whether the points of a first plane are farther apart along the ray than noise
        puts them; otherwise the plane may be turned towards the ray.

        A slope variance v with a height variance h means a variance h (1 / v - 1 / v_0) of the
        places, v_0 that of the first estimate. Points on one place seem to have the variance
        var(e) |B^T u|^2 / N from noise along the plane.
        """
        ray = cython.declare(cython.double[2])
        self._ray_in_plane(leaf, run, ray)
        known = leaf.range_part
        flat = ray[0] * ray[0] + ray[1] * ray[1]
        slope = ray[0] * ray[0] * known[0] + 2.0 * ray[0] * ray[1] * known[1]
        slope += ray[1] * ray[1] * known[4]
        sure = flat / max(slope, 1e-300) - 1.0 / (LEVEL_SIGMA * LEVEL_SIGMA)
        height = self._height_variance(known)
        noise = run.variance / (run.cosine * run.cosine * run.points)
        return height * sure >= MIN_SPREAD * noise * flat
