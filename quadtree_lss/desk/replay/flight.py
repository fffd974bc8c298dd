# SPDX-License-Identifier: Apache-2.0
"""Scans and poses of a bag, and the disagreement of the scans."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import linregress

from quadtree_lss.desk.replay.suggest import variance_about_planes
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import LidarConfig
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.messages.clouds import stamp_ns
from quadtree_lss.onboard.messages.intake import ReadyScan

MAX_SCANS, MAX_POINTS = 60, 800
"""Number of scans kept of a bag, in consecutive pairs, and of points kept of each scan."""
SAMPLES, NEIGHBOURS, MIN_OTHERS = 2000, 9, 3
"""Number of points at which scans are compared, of nearest neighbours of each, and of those that
must belong to other scans."""
MIN_POINTS = 8
"""Scans with fewer points are not used."""
SEPARATION_M = 1e4
"""Distance between scans that leaves them without common neighbours."""
MIN_OVERLAP = 0.3
"""Share of the points with neighbours of other scans below which scans do not overlap."""
MIN_IN_RANGE = 0.25
"""Share of returns within the lidar's limits below which the unit or the limits are wrong."""
NEAR, VOXEL_M, RECURRING, ALOFT = 0.5, 0.3, 0.5, 0.3
"""Returns of the vehicle are nearer than this share of the median range, in voxels of this size
that occur in this share of the scans, and above the ground by this share of the lidar's height."""
MIN_CORRELATION, MIN_HEIGHT_RATIO = 0.95, 1.0 / 300.0
"""Least correlation of heights of poses and ranges to derive the unit of the poses; least plausible
ratio of range to height."""


class _Scan(NamedTuple):
    stamp_ns: int
    middle_ns: int  # median time of its points
    points: Array
    pose: Pose  # of the lidar at the stamp


class Recording:
    """All poses and some scans of a bag with ``count`` scans. ``poses``: stamp, ns, position, m,
    and quaternion x, y, z, w; ``has_times``: points have times."""

    def __init__(self, count: int) -> None:
        self._every, self._count = max(-(-count // MAX_SCANS), 1), 0
        self._scans: list[_Scan] = []
        self.poses: list[tuple[int, Array, Array]] = []
        self.has_times = False

    def add_scan(self, scan: ReadyScan) -> None:
        self._count += 1
        if (self._count - 1) // 2 % self._every:
            return
        points, middle = scan.points_lidar.reshape(-1, 3).astype(np.float64), scan.stamp_ns
        valid = np.isfinite(points).all(axis=1) & points.any(axis=1)
        if np.count_nonzero(valid) < MIN_POINTS:
            return
        if scan.sweep is not None:
            self.has_times = True
            middle += int(np.median(scan.sweep.offsets[valid]))
        every = max(np.count_nonzero(valid) // MAX_POINTS, 1)
        self._scans.append(_Scan(scan.stamp_ns, middle, points[valid][::every], scan.pose))

    def add_pose(self, msg: Any) -> None:
        p, q = msg.pose.pose.position, msg.pose.pose.orientation
        position, quaternion = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
        length = np.linalg.norm(quaternion)
        if np.isfinite(position).all() and length > 0.5:
            self.poses.append((stamp_ns(msg.header), position, quaternion / length))

    def flight(self, lidar: LidarConfig) -> Flight | None:
        """Return the flight; None if fewer than three scans have a pose."""
        scans = self._scans if len({stamp for stamp, *_ in self.poses}) > 1 else []
        return Flight(scans, self.poses, lidar) if len(scans) > 2 else None


class Flight:
    """Scans with the poses of the body and of the lidar.

    ``points``: (N, 3), lidar axes; ``scan``: (N,), index of the scan of each point. Positions and
    rotations for K scans: ``positions`` and ``body`` of the body in the map, ``arms`` and
    ``mounts`` of the lidar on the body, ``origins`` and ``turns`` of the lidar in the map.
    """

    def __init__(
        self, scans: list[_Scan], poses: list[tuple[int, Array, Array]], lidar: LidarConfig
    ) -> None:
        path_ns, first = np.unique([stamp for stamp, *_ in poses], return_index=True)
        self._path_times = 1e-9 * (path_ns - path_ns[0])
        self._path = np.array([poses[k][1] for k in first])
        self._path_turns = Slerp(self._path_times, Rotation.from_quat([poses[k][2] for k in first]))
        self.points = np.concatenate([scan.points for scan in scans])
        self.scan = np.repeat(np.arange(len(scans)), [len(scan.points) for scan in scans])
        stamps, middles = np.array([scan[:2] for scan in scans]).T - path_ns[0]
        at, turn = self._interpolate(1e-9 * stamps)
        back = turn.transpose(0, 2, 1)
        self.arms = np.einsum("kij,kj->ki", back, [scan.pose.position for scan in scans] - at)
        self.mounts = back @ np.array([scan.pose.rotation_map_lidar for scan in scans])
        self.times, self.last = 1e-9 * middles, float(self._path_times[-1])
        self.positions, self.body = self._interpolate(self.times)
        self.origins, self.turns = place_lidar(self.positions, self.body, self.arms, self.mounts)
        self.ranges = np.linalg.norm(self.points, axis=1)
        self._limits, self._own = (lidar.min_range, lidar.max_range), np.zeros(len(self.scan), bool)

    def _interpolate(self, times: Array) -> tuple[Array, Array]:
        """Return positions (K, 3), rotations (K, 3, 3) of the body at times (K,), s, clipped to the
        poses."""
        times = np.clip(times, self._path_times[0], self._path_times[-1])
        positions = [np.interp(times, self._path_times, along) for along in self._path.T]
        return np.column_stack(positions), self._path_turns(times).as_matrix()

    def used(self, scale: float = 1.0) -> NDArray[np.bool_]:
        """Return which points, in metres after ``scale``, the map uses."""
        low, high = self._limits
        ranges = scale * self.ranges
        return np.asarray((ranges >= low) & (ranges <= high) & ~self._own)

    def exclude_own_returns(self) -> tuple[float, float] | None:
        """Exclude returns of the vehicle itself from later comparisons. Return their share and
        their greatest range, m; None if there are none, or nearer ground would be lost."""
        used = self.used()
        near = used & (self.ranges < NEAR * np.median(self.ranges[used])) if used.any() else used
        if not near.any():
            return None
        voxel = np.floor(self.points[near] / VOXEL_M).astype(np.int64)
        voxel = np.unique(voxel, axis=0, return_inverse=True)[1].reshape(-1)
        hits = np.bincount(np.unique(voxel * 2**20 + self.scan[near]) >> 20)
        own = near.copy()
        own[near] = hits[voxel] >= RECURRING * len(self.times)
        if not own.any():
            return None
        others = used & ~own
        heights, ground = self._heights(others)
        aloft = heights - ground[self.scan] > ALOFT * np.abs(ground[self.scan])
        farthest = float(self.ranges[own].max())
        if np.mean(aloft[own]) < 0.8 or np.mean(self.ranges[others] < 1.1 * farthest) > 0.02:
            return None
        self._own = own
        return own.sum() / used.sum(), farthest

    def _heights(self, ground: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return the heights (N,) of the points above the lidar, and their medians (K,) over the
        ``ground`` points of each scan, NaN without any, m."""
        heights = np.einsum("nj,nj->n", self.turns[self.scan][:, 2], self.points)
        medians = np.full(len(self.times), np.nan)
        for k in np.unique(self.scan[ground]):
            medians[k] = np.median(heights[ground & (self.scan == k)])
        return heights, medians

    def unit_of_heights(self) -> float:
        """Estimate the unit of the poses' heights, m, from the change of the lidar's height above
        the ground, or from implausibly large heights; NaN if neither is possible."""
        above = -self._heights(self.used())[1]
        known = np.isfinite(above)
        z, above = self.origins[known, 2], above[known]
        if len(z) < 3 or not np.ptp(z):
            return np.nan
        fit = linregress(z, above)
        if fit.rvalue > MIN_CORRELATION and fit.slope > 0.0:
            return float(fit.slope)
        ratio = float(np.median(above / z))
        return ratio if 0.0 < ratio < MIN_HEIGHT_RATIO else np.nan

    def disagreement_with_lag(self, lag: float, chosen: NDArray[np.bool_]) -> float:
        """Return the disagreement of the chosen scans with the poses ``lag`` s later, m."""
        body = self._interpolate(self.times + lag)
        return self.disagreement(*place_lidar(*body, self.arms, self.mounts), chosen=chosen)[0]

    def disagreement(
        self, origins: Array, turns: Array, scale: float = 1.0,
        chosen: NDArray[np.bool_] | None = None, others: int = MIN_OTHERS,
    ) -> tuple[float, float]:  # fmt: skip
        """Return the disagreement of scans, m, and the share of points above the lidar.

        The disagreement is the median standard deviation about a plane of neighbouring points, at
        least ``others`` of them of other scans; infinite if scans do not overlap. ``origins``
        (K, 3), ``turns`` (K, 3, 3): of the lidar; ``scale``: unit of the points, m; ``chosen``:
        (K,) scans to compare, None for all.
        """
        used = self.used(scale) if chosen is None else self.used(scale) & chosen[self.scan]
        if np.count_nonzero(used) < NEIGHBOURS:
            return np.inf, 0.0
        scan = self.scan[used]
        points = np.einsum("nij,nj->ni", turns[scan], scale * self.points[used]) + origins[scan]
        above = float(np.mean(points[:, 2] > origins[scan, 2]))
        few = slice(None, None, max(len(points) // SAMPLES, 1))
        near = np.asarray(cKDTree(points[:, :2]).query(points[few, :2], k=NEIGHBOURS)[1])
        common = np.sum(scan[near] != scan[few, None], axis=1) >= others
        if common.mean() < MIN_OVERLAP:
            return np.inf, above
        x, y, z = np.moveaxis(points[near[common]] - points[few][common, None], -1, 0)
        return float(np.sqrt(np.median(variance_about_planes(x, y, z)))), above

    def scatter_within_scans(self) -> float:
        """Return the `disagreement` of each scan with itself, m: the least for scans that agree."""
        shifts = SEPARATION_M * np.arange(len(self.times))[:, None] * [1.0, 0.0, 0.0]
        return self.disagreement(self.origins + shifts, self.turns, others=0)[0]


def place_lidar(positions: Array, body: Array, arms: Array, mounts: Array) -> tuple[Array, Array]:
    """Return positions and rotations of the lidar in the map from those of body and mount."""
    return positions + np.einsum("kij,kj->ki", body, arms), body @ mounts
