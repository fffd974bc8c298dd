# SPDX-License-Identifier: Apache-2.0
"""Scans and poses of a bag, and how far the scans lie from common ground."""

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

MOST_SCANS, MOST_POINTS = 60, 800
"""Number of scans kept of a bag, as pairs of neighbours, and of points kept of each scan."""
PLACES, NEIGHBOURS, OTHERS = 2000, 9, 3
"""Scans are compared at so many points, each with its nearest neighbours, of which so many must be
of other scans."""
FEWEST = 8
"""Fewest points of a scan."""
FAR_APART_M = 1e4
"""Distance to which scans are moved so that they have no common neighbours."""
OVERLAP = 0.3
"""Least share of the points with such neighbours; with less, scans see no common ground."""
IN_RANGE = 0.25
"""Least share of returns within the lidar's limits; with less, the unit or the limits are wrong."""
NEAR, VOXEL_M, RECURRING, ALOFT = 0.5, 0.3, 0.5, 0.3
"""Returns of the vehicle are nearer than this share of the median range, in voxels of this size
that this share of the scans hits, and above the ground by this share of the lidar's height."""
LEAST_CORRELATION, ABSURD = 0.95, 1.0 / 300.0
"""Least correlation of heights of poses and ranges to derive the unit of poses; share of a height
that no range can be in a flight with lidar."""


class _Scan(NamedTuple):
    stamp_ns: int
    middle_ns: int  # median time of its points
    points: Array
    pose: Pose  # of the lidar at the stamp


class Recording:
    """All poses and some scans of a bag with ``count`` scans. ``poses``: stamp, position,
    quaternion; ``has_times``: whether points have times of their own."""

    def __init__(self, count: int) -> None:
        self._every, self._count = max(-(-count // MOST_SCANS), 1), 0
        self._scans: list[_Scan] = []
        self.poses: list[tuple[int, Array, Array]] = []
        self.has_times = False

    def add_scan(self, scan: ReadyScan) -> None:
        self._count += 1
        if (self._count - 1) // 2 % self._every:
            return
        points, middle = scan.points_lidar.reshape(-1, 3).astype(np.float64), scan.stamp_ns
        sound = np.isfinite(points).all(axis=1) & points.any(axis=1)
        if np.count_nonzero(sound) < FEWEST:
            return
        if scan.sweep is not None:
            self.has_times = True
            middle += int(np.median(scan.sweep.offsets[sound]))
        every = max(np.count_nonzero(sound) // MOST_POINTS, 1)
        self._scans.append(_Scan(scan.stamp_ns, middle, points[sound][::every], scan.pose))

    def add_pose(self, msg: Any) -> None:
        p, q = msg.pose.pose.position, msg.pose.pose.orientation
        position, turn = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
        size = np.linalg.norm(turn)
        if np.isfinite(position).all() and size > 0.5:
            self.poses.append((stamp_ns(msg.header), position, turn / size))

    def flight(self, lidar: LidarConfig) -> Flight | None:
        """Return the flight; None if fewer than three scans have a pose."""
        scans = self._scans if len({stamp for stamp, *_ in self.poses}) > 1 else []
        return Flight(scans, _Path(self.poses), lidar) if len(scans) > 2 else None


class _Path:
    """Positions and rotations by time, s after ``start_ns``. Of equal stamps the first is used."""

    def __init__(self, poses: list[tuple[int, Array, Array]]) -> None:
        stamps, first = np.unique([stamp for stamp, *_ in poses], return_index=True)
        self.start_ns = int(stamps[0])
        self.times = 1e-9 * (stamps - stamps[0])
        self._positions = np.array([poses[k][1] for k in first])
        self._turns = Slerp(self.times, Rotation.from_quat([poses[k][2] for k in first]))

    def interpolate(self, times: Array) -> tuple[Array, Array]:
        """Positions (K, 3) and rotations (K, 3, 3) at times (K,) s, clipped to the path."""
        times = np.clip(times, self.times[0], self.times[-1])
        positions = [np.interp(times, self.times, along) for along in self._positions.T]
        return np.column_stack(positions), self._turns(times).as_matrix()


class Flight:
    """Scans with the poses of the body and of the lidar.

    ``points`` are (N, 3), lidar axes; ``scan`` (N,) is the scan of each. Of K scans, ``positions``
    and ``body`` are those of the body, ``arms`` and ``mounts`` of the lidar on it, ``origins`` and
    ``turns`` of the lidar in the map.
    """

    def __init__(self, scans: list[_Scan], path: _Path, lidar: LidarConfig) -> None:
        self.points = np.concatenate([scan.points for scan in scans])
        self.scan = np.repeat(np.arange(len(scans)), [len(scan.points) for scan in scans])
        stamps, middles = np.array([scan[:2] for scan in scans]).T - path.start_ns
        at, turn = path.interpolate(1e-9 * stamps)
        back = turn.transpose(0, 2, 1)
        self.arms = np.einsum("kij,kj->ki", back, [scan.pose.position for scan in scans] - at)
        self.mounts = back @ np.array([scan.pose.rotation_map_lidar for scan in scans])
        self._path, self.times, self.last = path, 1e-9 * middles, float(path.times[-1])
        self.positions, self.body = path.interpolate(self.times)
        self.origins, self.turns = place_lidar(self.positions, self.body, self.arms, self.mounts)
        self.ranges = np.linalg.norm(self.points, axis=1)
        self._limits, self._own = (lidar.min_range, lidar.max_range), np.zeros(len(self.scan), bool)

    def used(self, scale: float = 1.0) -> NDArray[np.bool_]:
        """Return which points, in metres after ``scale``, the map uses."""
        low, high = self._limits
        ranges = scale * self.ranges
        return np.asarray((ranges >= low) & (ranges <= high) & ~self._own)

    def leave_out_own(self) -> tuple[float, float] | None:
        """Find returns of the vehicle itself and leave them out of later comparisons. Return their
        share and their greatest range, m; None if there are none, or nearer ground would be lost.
        """
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
        """Heights of the points (N,) above the lidar, and the medians (K,) of those of the ground
        in each scan, NaN without one, m."""
        heights = np.einsum("nj,nj->n", self.turns[self.scan][:, 2], self.points)
        medians = np.full(len(self.times), np.nan)
        for k in np.unique(self.scan[ground]):
            medians[k] = np.median(heights[ground & (self.scan == k)])
        return heights, medians

    def unit_of_heights(self) -> float:
        """Unit of the poses' heights, m, by the change of the lidar's height above the ground, or
        by far too large heights; NaN if neither shows one."""
        above = -self._heights(self.used())[1]
        known = np.isfinite(above)
        z, above = self.origins[known, 2], above[known]
        if len(z) < 3 or not np.ptp(z):
            return np.nan
        fit = linregress(z, above)
        if fit.rvalue > LEAST_CORRELATION and fit.slope > 0.0:
            return float(fit.slope)
        ratio = float(np.median(above / z))
        return ratio if 0.0 < ratio < ABSURD else np.nan

    def disagreement_with_lag(self, lag: float, chosen: NDArray[np.bool_]) -> float:
        """Disagreement of the chosen scans with the poses ``lag`` s later, m."""
        body = self._path.interpolate(self.times + lag)
        return self.disagreement(*place_lidar(*body, self.arms, self.mounts), chosen=chosen)[0]

    def disagreement(
        self, origins: Array, turns: Array, scale: float = 1.0,
        chosen: NDArray[np.bool_] | None = None, others: int = OTHERS,
    ) -> tuple[float, float]:  # fmt: skip
        """How far scans lie from common ground, m, and the share of points above the lidar.

        The median standard deviation of neighbouring points of several scans (at least ``others``
        of other ones) about a plane; infinite if scans do not overlap. ``origins``, ``turns``:
        (K, 3) and (K, 3, 3) of the lidar; ``scale``: takes points to metres; ``chosen``: scans to
        compare, None for all.
        """
        used = self.used(scale) if chosen is None else self.used(scale) & chosen[self.scan]
        if np.count_nonzero(used) < NEIGHBOURS:
            return np.inf, 0.0
        scan = self.scan[used]
        placed = np.einsum("nij,nj->ni", turns[scan], scale * self.points[used]) + origins[scan]
        above = float(np.mean(placed[:, 2] > origins[scan, 2]))
        few = slice(None, None, max(len(placed) // PLACES, 1))
        near = np.asarray(cKDTree(placed[:, :2]).query(placed[few, :2], k=NEIGHBOURS)[1])
        common = np.sum(scan[near] != scan[few, None], axis=1) >= others
        if common.mean() < OVERLAP:
            return np.inf, above
        x, y, z = np.moveaxis(placed[near[common]] - placed[few][common, None], -1, 0)
        return float(np.sqrt(np.median(variance_about_planes(x, y, z)))), above

    def scatter_alone(self) -> float:
        """`disagreement` of each scan with itself, m: scans that agree differ by no more."""
        apart = FAR_APART_M * np.arange(len(self.times))[:, None] * [1.0, 0.0, 0.0]
        return self.disagreement(self.origins + apart, self.turns, others=0)[0]


def place_lidar(positions: Array, body: Array, arms: Array, mounts: Array) -> tuple[Array, Array]:
    """Positions and rotations of the lidar in the map from those of the body and the mount."""
    return positions + np.einsum("kij,kj->ki", body, arms), body @ mounts
