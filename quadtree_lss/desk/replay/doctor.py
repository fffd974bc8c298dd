# SPDX-License-Identifier: Apache-2.0
"""Faults of clouds and poses, and the setting that fixes each.

Frames, axes, units, lag and mount are judged by the ground: scans that are placed right lie below
the lidar and agree with each other. Each common fault is corrected in turn. A fault is claimed only
if scans disagree with it and agree clearly better without.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from quadtree_lss.desk.replay.configuration import scalar_text
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config, LidarConfig, MountConfig
from quadtree_lss.onboard.core.geometry.rotations import (
    exp,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import AXES, cloud_turn, fixed_mount
from quadtree_lss.onboard.messages.clouds import MessageError, points_from_cloud, stamp_ns
from quadtree_lss.onboard.messages.lost_points import LOOKING_DOWN, NED_FROM_ENU
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
BETTER, NOISES = 0.4, 3.0
"""What is mended must be so much better, and what there is worse than the noise by this."""
ALIKE = 10.0
"""Scans that see no common ground must see it so well when mended, in deviations of the noise."""
MOST_ABOVE, MENDED_ABOVE = 0.5, 0.05
"""Share of points above the lidar: of houses about one that stands, and of what is mended."""
LAGS, FINER = np.linspace(-0.5, 0.5, 21), np.linspace(-0.04, 0.04, 9)
LEAST_LAG, LAG_GAIN = 0.03, 0.8
"""s; and the share of the disagreement that is left without the lag."""
LEVEL_DEG, LEAST_DEG, SURE = 3.0, 2.0, 3.0
"""Of ground: how far from level it may be on the whole; of a mount: what is no error; sigmas."""
CALM_DEG = 5.0
"""A flight is too calm if by it a mount that is so far off is not found."""
GROUNDS = 5.0
"""Independent grounds that a flight sees: neighbouring scans see the same slopes."""
FLIP = np.diag([1.0, -1.0, -1.0])
IN_RANGE = 0.25
"""Share of a cloud's returns within the lidar's range; with less its unit or range is wrong."""
JUMPY = 0.3
"""Of the range: scans without common ground disagree if their heights scatter by more."""
NEAR, VOXEL_M, RECURRING, ALOFT = 0.5, 0.3, 0.5, 0.3
"""Returns of the vehicle itself: nearer than this share of the median range, in cubes of this side
that this share of the scans hit, and above the ground by this share of the lidar's height."""
STEEP_DEG = 12.0
"""A common slope that is rather a map whose z axis is not up."""
FAR_M = 1e5
"""Beyond it places are those of a geographic grid."""
ZIGZAG = 5.0
"""Poses alternate between two paths if they leap by so many of their steps."""


class Finding(NamedTuple):
    """What is wrong or to know, by a short name and in one line; what to do about it, empty where
    nothing need be done, and as parameters where these do it. ``fatal``: nothing can be mapped."""

    key: str
    text: str
    mend: str = ""
    fatal: bool = False
    settings: dict[str, Any] | None = None

    @property
    def line(self) -> str:
        return f"{self.text}; mend: {self.mend}" if self.mend else self.text


class Heard:
    """Some scans, all poses and gimbal angles of a bag.

    ``mount``: of the lidar on the body where that is fixed. ``tf_mounts``: what it may be by
    ``/tf_static``, by the body's frame.
    """

    def __init__(self) -> None:
        self._scans: list[tuple[int, Array]] = []
        self._every, self._count = 1, 0
        self._poses: list[tuple[int, Array, Array]] = []
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
            self._poses.append((stamp_ns(msg.header), place, turn / size))

    def add_gimbal(self, msg: Any) -> None:
        angle = mount_from_message(msg)
        turn = Rotation.from_matrix(angle.rotation_map_lidar).as_quat()
        self._gimbal.append((angle.stamp_ns, angle.position, turn))

    def findings(self, config: Config, *, timed: bool = True) -> list[Finding]:
        """What the messages and the ground say. ``timed``: the points' times, if any, are known;
        otherwise no lag is judged."""
        found = self._path_findings()
        flight = self._flight(config)
        if flight is None:
            return found
        return found + _judged(flight, config, self.tf_mounts, timed=timed)

    def _path_findings(self) -> list[Finding]:
        """Poses of two publishers on one topic, and of a geographic grid."""
        places = np.array([place for _, place, _ in sorted(self._poses, key=lambda pose: pose[0])])
        if len(places) < 8:
            return []
        leap = np.linalg.norm(places[1:-1] - 0.5 * (places[:-2] + places[2:]), axis=1)
        leap_m, step_m = np.median(leap), np.median(np.linalg.norm(places[2:] - places[:-2], axis=1))
        if leap_m > max(ZIGZAG * step_m, 0.05):
            text = f"poses alternate between two paths {leap_m:.2g} m apart: two publishers?"
            return [Finding("two_paths", text, "record each on its own topic, choose one of them")]
        x, y, _ = np.median(places, axis=0)
        if max(abs(x), abs(y)) < FAR_M:
            return []
        text = f"poses are about x {x:.0f}, y {y:.0f} m, as of UTM: the domain has to lie there"
        text += " (config suggest writes it), and so will the results"
        return [Finding("far", text)]

    def _flight(self, config: Config) -> _Flight | None:
        """What can be compared; None where scans and poses are of other times, or too few."""
        poses = {stamp: (place, turn) for stamp, place, turn in self._poses}
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
        return _Flight(scans, body, gimbal, mount, config.lidar)


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


class _Flight:
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
        self.origins, self.turns = _of_lidar(self.places, self.body, self.arms, self.mounts)
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
        return self.disagreement(*_of_lidar(*self._at(self.times + lag)), chosen=chosen)[0]

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


def _of_lidar(places: Array, body: Array, arms: Array, mounts: Array) -> tuple[Array, Array]:
    return places + np.einsum("kij,kj->ki", body, arms), body @ mounts


def setting(key: str, text: str, settings: dict[str, Any]) -> Finding:
    """A fault that parameters fix."""
    mend = ", ".join(f"{name}: {scalar_text(value)}" for name, value in settings.items())
    return Finding(key, text, mend, settings=settings)


class _Try(NamedTuple):
    """A fault, and where the lidar was without it."""

    fault: Finding
    origins: Array
    turns: Array
    scale: float = 1.0


MAP_CLOUD = (
    "clouds are in the map's frame already",
    "choose those in the lidar's own axes by --scan-topic (of FAST-LIO /cloud_registered_body), or"
    " write the clouds to files and replay these: without --poses they are taken as of the map",
)
NO_MOUNT = {f"mount.{name}": value for name, value in asdict(MountConfig()).items()}


def _tries(flight: _Flight, config: Config, tf_mounts: Mapping[str, Pose]) -> list[_Try]:
    """The common faults; of those that explain the scans equally well the first is the likelier."""
    p, b, m, at = flight.places, flight.body, flight.mounts, flight.origins
    own = m @ cloud_turn(config.mount).T
    tries = []
    for frame, mount in tf_mounts.items():
        text = f"poses are of '{frame}', on which /tf_static has the lidar"
        fault = setting("mount_tf", text, {"mount.source": "tf", "frames.body": frame})
        arm, turn = np.broadcast_to(mount.position, p.shape), mount.rotation_map_lidar
        tries.append(_Try(fault, *_of_lidar(p, b, arm, np.broadcast_to(turn, b.shape))))
    for name, turn in AXES.items():
        if name != config.mount.axes:
            text = f"clouds and poses are of different axes ({name.replace('_', ' ')})"
            fault = setting("axes", text, {"mount.axes": name})
            tries.append(_Try(fault, at, b @ own @ turn))
    if not np.allclose(own, np.eye(3)):
        text = "poses are the lidar's own, and a mount is set"
        keep = {**NO_MOUNT, "mount.axes": config.mount.axes}
        fault = Finding("mount", text, "leave out mount.*", settings=keep)
        if config.mount.source == "tf":
            fault = Finding("mount", "poses are the lidar's own", "correct their child frame")
        tries.append(_Try(fault, p, b @ cloud_turn(config.mount)))
    if config.mount.source == "fixed":
        text = "poses are a level body's, and the lidar looks down from it"
        for name, turn in (("roll_deg", LOOKING_DOWN), ("pitch_deg", exp([0.0, np.pi / 2, 0.0]))):
            values = {f"mount.{name}": 180.0 if name == "roll_deg" else 90.0}
            tries.append(_Try(setting("mount", text, values), at, b @ own @ turn))
    text = "poses are in north, east, down; the map is east, north, up"
    mend = "convert them (docs/connecting.md), or take autopilot_node's or MAVROS's nav/odometry"
    ned, fault = NED_FROM_ENU, Finding("ned", text, mend)
    north = [
        _Try(fault, *_of_lidar(p @ ned.T, ned @ b @ body, flight.arms, m))
        for body in (np.eye(3), FLIP)
    ]
    tries = north + tries if np.median(p[:, 2]) < 0.0 else tries + north
    mend = "exchange them: x, y, z, w = q[1], q[2], q[3], q[0]"
    first = rotation_from_quaternion(quaternion_from_rotation(b)[:, [1, 2, 3, 0]])
    tries.append(_Try(Finding("quaternion", "orientations have w first", mend), at, first @ m))
    text = "orientations take the map's axes to the lidar's, not back"
    fault = Finding("inverse", text, "publish their inverse: -x, -y, -z, w")
    tries.append(_Try(fault, p, b.transpose(0, 2, 1) @ m))
    for scale, unit in ((1e-3, "millimetres"), (1e-2, "centimetres")):
        mend = f"publish metres: x, y, z times {scale:g}"
        fault = Finding("units", f"clouds are in {unit}", mend)
        tries.append(_Try(fault, at, b @ m, scale))
        mend = f"publish metres: positions times {scale:g}"
        fault = Finding("pose_units", f"poses are in {unit}", mend)
        tries.append(_Try(fault, scale * p + at - p, b @ m))
    here = np.tile(np.eye(3), (len(p), 1, 1))
    return [*tries, _Try(Finding("map_cloud", *MAP_CLOUD), np.zeros_like(p), here)]


def _judged(
    flight: _Flight, config: Config, tf_mounts: Mapping[str, Pose], *, timed: bool
) -> list[Finding]:
    """What the ground says: of the vehicle itself, of axes, frames and units, of lag, of mount."""
    own = flight.leave_out_own()
    found = [] if own is None else [own]
    cost, above = flight.disagreement(flight.origins, flight.turns)
    noise = config.lidar.range_noise
    sound = above <= MOST_ABOVE and flight.used(1.0).mean() > IN_RANGE
    disagrees = cost > NOISES * noise if np.isfinite(cost) else flight.scatter() > JUMPY
    limit = BETTER * cost if np.isfinite(cost) else ALIKE * noise
    if not sound or disagrees:
        best: tuple[float, _Try] | None = None
        for tried in _tries(flight, config, tf_mounts):
            if flight.used(tried.scale).mean() <= IN_RANGE:
                continue
            if sound and tried.scale != 1.0 and cost < 30.0 * noise:
                continue
            left, over = flight.disagreement(tried.origins, tried.turns, tried.scale)
            if tried.fault.key == "map_cloud":
                over = float(np.mean(flight.points[:, 2] > flight.places[flight.of, 2]))
            if over <= MENDED_ABOVE and (best is None or left < 0.8 * best[0]):
                best = left, tried
        if best is not None and np.isfinite(best[0]) and (not sound or best[0] < limit):
            fault = best[1].fault
            text = f"{fault.text}: {_state(cost, above, best[0])}"
            return [*found, fault._replace(text=text)]
    if above > MOST_ABOVE:
        text = f"{100 * above:.0f} % of the ground lies above the lidar"
        mend = "look at frames and axes (docs/connecting.md): no common fault explains it"
        return [*found, Finding("above", text, mend)]
    return [*found, *((timed and _lag(flight)) or _mount(flight, config)), *_tilt(flight)]


def _tilt(flight: _Flight) -> list[Finding]:
    """Ground with a slope that is rather the map's."""
    used = flight.used(1.0)
    placed = np.einsum("nij,nj->ni", flight.turns[flight.of], flight.points) + flight.origins[flight.of]
    placed = placed[used] - placed[used].mean(axis=0)
    normal = np.linalg.svd(placed[:: max(len(placed) // 4000, 1)], full_matrices=False)[2][2]
    slope = float(np.degrees(np.arccos(min(abs(normal[2]), 1.0))))
    if slope < STEEP_DEG:
        return []
    text = f"the ground slopes by {slope:.0f} deg on the whole: if it does not, z of the map is not"
    text += " up, as with an odometry that begins with the lidar's first attitude (camera_init);"
    text += " align that with gravity, or with its IMU, and run it on the recording again"
    return [Finding("tilt", text)]


def _state(cost: float, above: float, mended: float) -> str:
    words = [f"{100 * above:.0f} % of the ground lies above the lidar"] * (above > MOST_ABOVE)
    if np.isfinite(mended):
        far = f"{cost:.2g} m" if np.isfinite(cost) else "not at all"
        words.append(f"mended, scans agree to {mended:.2g} m, and as it is {far}")
    return ", ".join(words)


def _lag(flight: _Flight) -> list[Finding]:
    """A constant delay between clouds and poses that brings the scans together."""
    chosen = (flight.times > -LAGS[0]) & (flight.times < flight.last - LAGS[-1])
    if np.count_nonzero(chosen) < 3:
        return []
    costs = np.array([flight.late(lag, chosen) for lag in LAGS])
    now, near = costs[len(LAGS) // 2], LAGS[int(np.argmin(costs))] + FINER
    costs = np.array([flight.late(lag, chosen) for lag in near])
    best = int(np.argmin(costs))
    lag = float(near[best])
    if not (np.isfinite(now) and abs(lag) >= LEAST_LAG and costs[best] < LAG_GAIN * now):
        return []
    late = "late" if lag < 0.0 else "early"
    text = f"clouds are stamped {abs(lag):.2f} s too {late} against the poses: scans agree to"
    text += f" {costs[best]:.2g} m with the poses of then, to {now:.2g} m with those of their stamp"
    mend = f"add {lag:+.2f} s to the clouds' stamps (the driver's time offset), or mend the poses'"
    return [Finding("lag", text, mend)]


def _mount(flight: _Flight, config: Config) -> list[Finding]:
    """Roll and pitch of the mount by which the ground keeps its slope, and is about level.

    Unknown are a small turn d of the lidar about two axes across the ground's normal and the
    ground's own normal n. Each scan k, whose normal is m_k in lidar axes, says R_k exp(d) m_k = n.
    """
    if config.mount.source == "gimbal":
        return []
    seen = flight.normals.any(axis=1)
    turns, normals = flight.turns[seen], flight.normals[seen]
    upward = np.sign(np.einsum("ki,ki->k", turns[:, 2, :], normals))
    normals = normals * np.where(upward == 0.0, 1.0, upward)[:, None]
    middle = normals.mean(axis=0)
    middle /= np.linalg.norm(middle)
    across = np.linalg.svd(middle[None])[2][1:]  # two axes

    def residuals(unknown: Array) -> Array:
        tilt = np.array([unknown[2], unknown[3], 1.0])
        told = np.einsum("kij,kj->ki", turns @ exp(unknown[:2] @ across), normals)
        return np.asarray(told - tilt / np.linalg.norm(tilt))

    deviation = 0.02
    for _ in range(3):  # the slopes' own deviation, and by it the weights
        sigma = deviation * np.sqrt(len(turns) / GROUNDS)

        def weighted(unknown: Array, sigma: float = sigma) -> Array:
            prior = unknown / np.radians([20.0, 20.0, LEVEL_DEG, LEVEL_DEG])
            return np.concatenate([residuals(unknown).ravel() / sigma, prior])

        fit = least_squares(weighted, np.zeros(4))
        deviation = max(1.2 * float(np.median(np.linalg.norm(residuals(fit.x), axis=1))), 0.002)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)
    angle = float(np.degrees(np.linalg.norm(fit.x[:2])))
    unsure = float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])))
    if angle < max(LEAST_DEG, SURE * unsure):
        if SURE * unsure < CALM_DEG:
            return []
        text = "the flight is too calm to find a short lag, or a lidar that looks"
        text += f" {SURE * unsure:.0f} deg beside where it should: turn and sway the vehicle"
        return [Finding("calm", text)]
    turn = exp(fit.x[:2] @ across)
    there = flight.disagreement(flight.origins, flight.turns @ turn)[0]
    now = flight.disagreement(flight.origins, flight.turns)[0]
    if not np.isfinite(there) or LAG_GAIN * there > now:
        return []  # hills in a long narrow view: what would correct a mount takes the scans apart
    mount = flight.mounts[0] @ turn @ cloud_turn(config.mount).T
    angles = np.round(Rotation.from_matrix(mount).as_euler("xyz", degrees=True), 1)
    roll, pitch, yaw = np.where(angles == -180.0, 180.0, angles)
    text = f"the lidar looks {angle:.1f} deg ({unsure:.1f}) beside where its mount says: the ground"
    text += " turns with the vehicle, or is far from level"
    if config.mount.source == "tf":
        mend = f"correct /tf_static: roll, pitch, yaw {roll:.1f}, {pitch:.1f}, {yaw:.1f} deg"
        return [Finding("mount_angle", text, mend)]
    values = {"mount.roll_deg": roll, "mount.pitch_deg": pitch, "mount.yaw_deg": yaw}
    return [setting("mount_angle", text, {k: float(v) for k, v in values.items()})]
