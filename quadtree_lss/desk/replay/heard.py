# SPDX-License-Identifier: Apache-2.0
"""Scans and poses of a bag as `doctor` compares them: how far scans lie from common ground."""

from __future__ import annotations

import contextlib
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from quadtree_lss.desk.replay.configuration import scalar_text
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config, LidarConfig
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import cloud_turn, fixed_mount
from quadtree_lss.onboard.messages.clouds import MessageError, points_from_cloud, stamp_ns
from quadtree_lss.onboard.messages.poses import mount_from_message
from quadtree_lss.onboard.messages.times import offsets_from_cloud

MOST_SCANS, MOST_POINTS = 60, 800
"""Looked at of a bag, in pairs of neighbours, which see the same ground, and of each scan."""
CELLS_ACROSS = 12
"""Cells over a scan's footprint, in each of which the scans are compared about one plane."""
FEWEST = 8
"""Points, of two scans at least, by which a cell is compared."""
OVERLAP = 0.3
"""Share of the points in such cells; with less the scans do not see the same ground."""
IN_RANGE = 0.25
"""Share of a cloud's returns within the lidar's range; with less its unit or range is wrong."""
NEAR, VOXEL_M, RECURRING, ALOFT = 0.5, 0.3, 0.5, 0.3
"""Returns of the vehicle itself: nearer than this share of the median range, in cubes of this side
that this share of the scans hit, and above the ground by this share of the lidar's height."""


class Finding(NamedTuple):
    """A fault or remark, by a short name and in one line; what to do about it, empty where
    nothing need be done, and as parameters where these do it. ``fatal``: nothing can be mapped."""

    key: str
    text: str
    mend: str = ""
    fatal: bool = False
    settings: dict[str, Any] | None = None

    @property
    def line(self) -> str:
        return f"{self.text}; mend: {self.mend}" if self.mend else self.text


def setting(key: str, text: str, settings: dict[str, Any]) -> Finding:
    """A fault that parameters fix."""
    mend = ", ".join(f"{name}: {scalar_text(value)}" for name, value in settings.items())
    return Finding(key, text, mend, settings=settings)


class Heard:
    """Some scans, all poses and gimbal angles of a bag.

    ``mount``: of the lidar on the body where that is fixed. ``tf_mounts``: what it may be by
    ``/tf_static``, by the body's frame.
    """

    def __init__(self) -> None:
        self._scans: list[tuple[int, Array]] = []
        self._every, self._count = 1, 0
        self.poses: list[tuple[int, Array, Array]] = []
        self._gimbal: list[tuple[int, Array, Array]] = []
        self.mount: Pose | None = None
        self.tf_mounts: dict[str, Pose] = {}

    def add(self, what: str, msg: Any) -> None:
        """A message of a `Stream`; depth images and their cameras say nothing here."""
        adds = {"cloud": self.add_cloud, "pose": self.add_pose, "gimbal": self.add_gimbal}
        if what in adds and (what != "cloud" or hasattr(msg, "fields")):
            with contextlib.suppress(MessageError):  # counted and told by the intake
                adds[what](msg)

    def add_cloud(self, msg: Any) -> None:
        """One scan, of which some points are kept."""
        self._count += 1
        if (self._count - 1) // 2 % self._every:
            return
        try:
            points = points_from_cloud(msg).reshape(-1, 3).astype(np.float64)
            stamp = stamp_ns(msg.header)
        except MessageError:
            return
        stamp += _middle(msg, stamp, points)
        points = points[np.isfinite(points).all(axis=1) & points.any(axis=1)]
        if len(points) >= FEWEST:
            self._scans.append((stamp, points[:: max(len(points) // MOST_POINTS, 1)]))
        if len(self._scans) == 2 * MOST_SCANS:
            self._scans, self._every = _thinned(self._scans, 2), 2 * self._every

    def add_pose(self, msg: Any) -> None:
        """One pose as it stands, whatever its frame."""
        p, q = msg.pose.pose.position, msg.pose.pose.orientation
        place, turn = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
        size = np.linalg.norm(turn)
        if np.isfinite(place).all() and size > 0.5:
            self.poses.append((stamp_ns(msg.header), place, turn / size))

    def add_gimbal(self, msg: Any) -> None:
        angle = mount_from_message(msg)
        turn = Rotation.from_matrix(angle.rotation_map_lidar).as_quat()
        self._gimbal.append((angle.stamp_ns, angle.position, turn))

    def flight(self, config: Config) -> Flight | None:
        """What can be compared; None where scans and poses are of other times, or too few."""
        poses = {stamp: (place, turn) for stamp, place, turn in self.poses}
        angles = {stamp: (place, turn) for stamp, place, turn in self._gimbal}
        if len(poses) < 2:
            return None
        start = min(poses)
        body, gimbal = _Path(poses, start), None
        mount = fixed_mount(config.mount) if self.mount is None else self.mount
        if config.mount.source == "gimbal" and len(angles) > 1:
            gimbal = _Path(angles, start)
        scans = [(1e-9 * (stamp - start), points) for stamp, points in self._scans]
        scans = [(t, points) for t, points in scans if 0.0 <= t <= body.times[-1]]
        if len(scans) < 3:
            return None
        scans = _thinned(scans, -(-len(scans) // MOST_SCANS))
        if mount is None:
            mount = Pose(0, np.zeros(3), cloud_turn(config.mount), np.zeros((6, 6)))
        return Flight(scans, body, gimbal, mount, config.lidar)


def _middle(msg: Any, stamp: int, points: Array) -> int:
    """Of the times of a scan's returns, if they have any, ns from its stamp: it is as of then."""
    with contextlib.suppress(MessageError):  # counted and told by the intake
        if (times := offsets_from_cloud(msg, stamp, points)) is not None:
            return int(np.median(times.offsets[np.isfinite(points[:, 2])]))
    return 0


def _thinned(scans: list[Any], every: int) -> list[Any]:
    """Of pairs every so-manieth."""
    return [scan for k, scan in enumerate(scans) if k // 2 % every == 0]


class _Path:
    """Places and quaternions by their stamps, at any time after ``start_ns`` in between."""

    def __init__(self, poses: dict[int, tuple[Array, Array]], start_ns: int) -> None:
        stamps = sorted(poses)
        self.times = 1e-9 * (np.array(stamps) - start_ns)
        places, turns = zip(*(poses[stamp] for stamp in stamps), strict=True)
        self._places, self._turns = np.array(places), Slerp(self.times, Rotation.from_quat(turns))

    def at(self, times: Array) -> tuple[Array, Array]:
        """Places (K, 3) and rotations (K, 3, 3) at times (K,) s; at an end where beyond it."""
        times = np.clip(times, self.times[0], self.times[-1])
        places = [np.interp(times, self.times, along) for along in self._places.T]
        return np.column_stack(places), self._turns(times).as_matrix()


class Flight:
    """Scans and where the lidar was."""

    def __init__(
        self,
        scans: list[tuple[float, Array]],
        body: _Path,
        gimbal: _Path | None,
        mount: Pose,
        lidar: LidarConfig,
    ) -> None:
        self.times = np.array([time for time, _ in scans])
        self.points = np.concatenate([points for _, points in scans])
        self.of = np.repeat(np.arange(len(scans)), [len(points) for _, points in scans])
        self._body, self._gimbal, self._mount = body, gimbal, mount
        self.places, self.body, self.arms, self.mounts = self._at(self.times)
        self.origins, self.turns = of_lidar(self.places, self.body, self.arms, self.mounts)
        self.last = float(body.times[-1])
        self.ranges = np.linalg.norm(self.points, axis=1)
        self._limits, self.own = (lidar.min_range, lidar.max_range), np.zeros(len(self.of), bool)
        self.range, self.cell, self.normals = 0.0, 0.0, np.zeros((len(scans), 3))
        self._measure()

    def _measure(self) -> None:
        """Range, normals of the scans and the side of a cell, by the points that are used."""
        used = self.used(1.0)
        if used.mean() <= IN_RANGE:
            used = ~self.own
        self.range = float(np.median(self.ranges[used]))
        spreads = []
        for k in range(len(self.times)):
            points = self.points[used & (self.of == k)]
            if len(points) >= FEWEST:
                _, sizes, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
                self.normals[k] = axes[2]
                spreads.append(4.0 * sizes[1] / np.sqrt(len(points)))
        self.cell = float(np.median(spreads)) / CELLS_ACROSS if spreads else 0.0

    def used(self, scale: float) -> NDArray[np.bool_]:
        """Which points the map uses: in range, and not of the vehicle itself."""
        low, high = self._limits
        return (scale * self.ranges >= low) & (scale * self.ranges <= high) & ~self.own

    def leave_out_own(self) -> Finding | None:
        """Returns of the vehicle itself: close by, always at the same place, far above the ground.
        They are not judged after this call."""
        used = self.used(1.0)
        near = used & (self.ranges < NEAR * self.range)
        if not near.any():
            return None
        cube = np.floor(self.points[near] / VOXEL_M).astype(np.int64)
        cube = np.unique(cube, axis=0, return_inverse=True)[1].reshape(-1)
        hits = np.bincount(np.unique(cube * 2**20 + self.of[near]) >> 20)
        own = near.copy()
        own[near] = hits[cube] >= RECURRING * len(self.times)
        if not own.any():
            return None
        heights = np.einsum("nj,nj->n", self.turns[self.of][:, 2], self.points)
        ground = np.full(len(self.times), np.nan)
        for k in np.unique(self.of[used & ~own]):
            ground[k] = np.median(heights[used & ~own & (self.of == k)])
        aloft = heights - ground[self.of] > ALOFT * np.abs(ground[self.of])
        farthest = float(self.ranges[own].max())
        least = float(np.ceil(11.0 * farthest)) / 10.0
        if np.mean(aloft[own]) < 0.8 or np.mean(self.ranges[used & ~own] < least) > 0.02:
            return None
        self.own = own
        self._measure()
        text = f"{100 * own.sum() / used.sum():.0f} % of the returns are always at the same place"
        text += f" close by, within {farthest:.2g} m: the vehicle itself"
        return setting("own_returns", text, {"lidar.min_range": least})

    def _at(self, times: Array) -> tuple[Array, Array, Array, Array]:
        """Places and rotations at times, s, of the body in the map and of the lidar on the body."""
        if self._gimbal is not None:
            return *self._body.at(times), *self._gimbal.at(times)
        arm, turn, n = self._mount.position, self._mount.rotation_map_lidar, len(times)
        return *self._body.at(times), np.tile(arm, (n, 1)), np.tile(turn, (n, 1, 1))

    def late(self, lag: float, chosen: NDArray[np.bool_]) -> float:
        """Disagreement of some scans with the poses of so many seconds later, m."""
        return self.disagreement(*of_lidar(*self._at(self.times + lag)), chosen=chosen)[0]

    def disagreement(
        self, origins: Array, turns: Array, scale: float = 1.0,
        chosen: NDArray[np.bool_] | None = None,
    ) -> tuple[float, float]:  # fmt: skip
        """How far the scans lie from common planes in cells, m, and the share above the lidar.

        In each cell with `FEWEST` points of two scans z = a + b x + c y is fitted; of the variances
        of what is left the median over the points counts. Infinite where scans do not overlap.
        ``origins``, ``turns``: (K, 3) and (K, 3, 3) of the lidar. ``chosen``: scans, None for all.
        """
        used = self.used(scale) if chosen is None else self.used(scale) & chosen[self.of]
        if not used.any() or self.cell == 0.0:
            return np.inf, 0.0
        points, of = scale * self.points[used], self.of[used]
        placed = np.einsum("nij,nj->ni", turns[of], points) + origins[of]
        above = float(np.mean(placed[:, 2] > origins[of, 2]))
        cell = max(scale * self.cell, 1e-6)
        corner = np.floor(placed[:, :2] / cell)
        corner -= corner.min(axis=0)
        key = (corner[:, 0] * 2.0**26 + corner[:, 1]).astype(np.int64)
        cells, inside = np.unique(key, return_inverse=True)
        scans = np.unique(inside.astype(np.int64) * 2**20 + of) >> 20
        x, y = (placed[:, :2] / cell - np.floor(placed[:, :2] / cell) - 0.5).T
        z = placed[:, 2] - float(np.median(placed[:, 2]))
        m = len(cells)
        basis = np.stack([np.ones_like(x), x, y])
        sums = [[np.bincount(inside, a * b, m) for a in basis] for b in (*basis, z)]
        normal, right = np.array(sums[:3]).transpose(2, 0, 1), np.array(sums[3]).T
        count = normal[:, 0, 0]
        good = (count >= FEWEST) & (np.bincount(scans, minlength=m) >= 2)
        if count[good].sum() < OVERLAP * len(x):
            return np.inf, above  # see `scatter`
        weak = normal + np.diag([1e-6, 1e-3, 1e-3])
        theta = np.linalg.solve(weak, right[..., None])[..., 0]
        left = np.bincount(inside, (z - np.sum(theta[inside] * basis.T, axis=1)) ** 2, m)
        variance = left[good] / (count[good] - 3.0)
        order = np.argsort(variance)
        middle = np.searchsorted(np.cumsum(count[good][order]), 0.5 * count[good].sum())
        return float(np.sqrt(variance[order[middle]])), above

    def scatter(self) -> float:
        """Standard deviation of the scans' median heights, in units of the range."""
        used = self.used(1.0)
        z = np.einsum("nj,nj->n", self.turns[self.of][:, 2], self.points) + self.origins[self.of, 2]
        heights = [np.median(z[used & (self.of == k)]) for k in np.unique(self.of[used])]
        return float(np.std(heights)) / self.range


def of_lidar(places: Array, body: Array, arms: Array, mounts: Array) -> tuple[Array, Array]:
    return places + np.einsum("kij,kj->ki", body, arms), body @ mounts
