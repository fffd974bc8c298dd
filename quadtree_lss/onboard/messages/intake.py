# SPDX-License-Identifier: Apache-2.0
"""Conversion of messages to scans with their poses, for nodes and replay."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from quadtree_lss.onboard.arrays import Points
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import MountedPoses
from quadtree_lss.onboard.core.sensing.pose_buffer import SECOND_NS, PoseBuffer
from quadtree_lss.onboard.core.sensing.pose_gate import PoseGate
from quadtree_lss.onboard.core.sensing.scan_queue import Drop, ScanQueue
from quadtree_lss.onboard.core.sensing.sweep import Sweep, interpolate_sweep, poses_during
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages.clouds import (
    MessageError,
    layout_note,
    points_from_cloud,
    stamp_ns,
)
from quadtree_lss.onboard.messages.depth import DepthCamera
from quadtree_lss.onboard.messages.extrinsics import Extrinsics
from quadtree_lss.onboard.messages.poses import (
    covariance_flaw,
    mount_from_message,
    pose_from_message,
)
from quadtree_lss.onboard.messages.times import PointTimes, offsets_from_cloud

NOISE_RATIO_LIMIT = 1.4
"""Ratio of observed to configured range noise, or its inverse, beyond which a warning is given."""

GAP_NS = 1_500_000_000
"""Longest interpolated gap between poses, ns: at 1 Hz a pose may be late by half a period."""
BUFFER_NS = 30 * SECOND_NS
"""Age at which poses are dropped, far above the waiting time of scans, ns."""

PERIOD_GAPS = 9
"""Number of gaps between clouds whose median is the scan period, because clouds can be lost or sent
twice."""


class Notice(NamedTuple):
    """A warning for the user: a key for counting and throttling, and one line of text."""

    reason: str
    text: str


class ReadyScan(NamedTuple):
    """A scan and the pose of the lidar at its stamp; points as of `points_from_cloud`. ``sweep``:
    motion of the lidar during the scan, None if it was instantaneous. ``edges``: dropped pixels of
    a depth image, at the edge of an object."""

    stamp_ns: int
    points_lidar: Points
    pose: Pose
    sweep: Sweep | None = None
    edges: int = 0

    def lost(self, dropped: Mapping[str, int]) -> dict[str, int]:
        """Return dropped points by reason, from ``ScanReport.dropped`` and the edges."""
        if not self.edges:
            return dict(dropped)
        return {**dropped, "no_return": dropped["no_return"] - self.edges, "edge": self.edges}


class _Cloud(NamedTuple):
    """A scan that waits for its pose."""

    points: Points
    times: PointTimes | None
    edges: int = 0


class Intake:
    """Decodes messages, queues scans until their poses arrive, and counts unusable messages.

    Call `on_pose`, `on_cloud`, `on_gimbal`, `on_transforms` with each message in order of arrival,
    then `ready`. No call raises on bad input: it is counted in ``rejected`` (``cloud_<reason>``,
    ``pose_<reason>``, …; ``times_<reason>`` for clouds whose point times are ignored) or
    ``queue.dropped`` and reported by `notices`. With a mount, poses are those of the body.
    """

    def __init__(
        self,
        config: Config,
        *,
        scan_topic: str = "lidar/points",
        pose_topic: str = "nav/pose",
        gimbal_topic: str = "lidar/gimbal",
    ) -> None:
        self._pose_config = config.pose
        self._map_frame = config.frames.map
        self.camera = DepthCamera(config.lidar)
        self._body = PoseBuffer(BUFFER_NS, GAP_NS)
        self._gate = PoseGate(GAP_NS)
        self._extrinsics = Extrinsics(config)
        self._gimbal: PoseBuffer | None = None
        mount: PoseBuffer | Pose | None = self._extrinsics.mount
        if config.mount.source == "gimbal":
            self._gimbal = mount = PoseBuffer(BUFFER_NS, GAP_NS, what="gimbal angle")
        self._mounted: MountedPoses | None = None
        if mount is not None or self._extrinsics.tf:
            lack = self._extrinsics.lack
            self._mounted = MountedPoses(self._body, mount, gimbal_topic, lack)
        self.queue = ScanQueue(
            self._body if self._mounted is None else self._mounted,
            max_scans=config.pose.queue,
            max_wait_ns=round(config.pose.max_wait * SECOND_NS),
            scan_topic=scan_topic,
            pose_topic=pose_topic,
        )
        self.rejected: Counter[str] = Counter()
        self.scans = 0
        self.poses_taken = 0
        self._notices: list[Notice] = []
        self._stamp_ns = 0
        self._gaps_ns: deque[int] = deque(maxlen=PERIOD_GAPS)

    @property
    def dropped(self) -> dict[str, int]:
        """Scans that were not mapped, by reason."""
        clouds = {k: v for k, v in self.rejected.items() if k.startswith("cloud_")}
        return {**clouds, **self.queue.dropped}

    def on_pose(self, msg: Any) -> None:
        """Use a pose of the lidar, or of the body if there is a mount: a
        ``PoseWithCovarianceStamped``, or an ``Odometry``, whose child frame is checked."""
        limits = self._pose_config
        try:
            if hasattr(msg, "child_frame_id"):
                self._extrinsics.check_body(msg.child_frame_id)
            pose = pose_from_message(
                msg,
                self._map_frame,
                unknown_position_sigma=limits.unknown_position_sigma,
                unknown_attitude_sigma_deg=limits.unknown_attitude_sigma_deg,
            )
        except MessageError as error:
            self.reject("pose", error)
            return
        flaw = covariance_flaw(msg)
        if flaw == "unknown":
            text = "pose covariance is zero, negative, not a number or huge where it is unknown:"
            text += f" using {limits.unknown_position_sigma:g} m and"
            text += f" {limits.unknown_attitude_sigma_deg:g} deg"
            text += " (pose.unknown_position_sigma, pose.unknown_attitude_sigma_deg)"
            self._notices.append(Notice("pose_covariance_unknown", text))
        elif flaw:
            text = "pose covariance is not symmetric or has a negative eigenvalue: only its"
            self._notices.append(Notice("pose_covariance", f"{text} variances are used"))
        dropped = self._gate.dropped
        for accepted in self._gate.filter(pose):
            self.poses_taken += self._add(self._body, accepted, "pose")
        if self._gate.dropped > dropped:
            self.rejected["pose_contradiction"] += self._gate.dropped - dropped
            text = "pose ignored: those before and after it lead elsewhere, beyond its covariance"
            self._notices.append(Notice("pose_contradiction", text))
        self._mount()

    def on_gimbal(self, msg: Any) -> None:
        """Use a ``TransformStamped`` from body to lidar."""
        if self._gimbal is None:
            return
        try:
            mount = self._extrinsics.turned(mount_from_message(msg))
            self._add(self._gimbal, mount, "gimbal")
        except MessageError as error:
            self.reject("gimbal", error)

    def on_transforms(self, msg: Any) -> None:
        """Use a ``TFMessage`` of ``/tf_static``, for ``mount.source: tf``."""
        try:
            self._extrinsics.on_transforms(msg)
        except MessageError as error:
            self.reject("transform", error)
        self._mount()

    def _mount(self) -> None:
        if self._extrinsics.tf and self._mounted is not None:
            self._mounted.mount = self._extrinsics.mount

    def on_camera_info(self, msg: Any) -> None:
        """Use the ``CameraInfo`` of the following depth images."""
        try:
            self.camera.on_info(msg)
        except MessageError as error:
            self.reject("camera_info", error)

    def on_cloud(self, msg: Any, arrival_ns: int) -> int | None:
        """Queue a ``PointCloud2`` or depth ``Image``; return its stamp, None if it is unusable.
        ``arrival_ns``: time on any steady clock, see `ready`."""
        depth = hasattr(msg, "encoding")
        try:
            points = self.camera.points(msg) if depth else points_from_cloud(msg)
            stamp = stamp_ns(msg.header)
            self._extrinsics.check_lidar(msg.header.frame_id)
        except MessageError as error:
            self.reject("cloud", error)
            return None
        edges = self.camera.edges if depth else 0
        if points.size == 0:
            self.reject("cloud", MessageError("empty", "cloud has no points"))
            return None
        times = None
        if not depth:
            if note := layout_note(msg):
                self._notices.append(Notice("cloud_sizes", note))
            try:
                times = offsets_from_cloud(msg, stamp, points, self._period_ns(stamp))
            except MessageError as error:
                self.reject("times", error)
        self.scans += 1
        self._mount()
        jumps = self.queue.jumps
        span_ns = (0, 0) if times is None else times.span
        self.queue.push_scan(stamp, _Cloud(points, times, edges), arrival_ns, span_ns)
        if self.queue.jumps != jumps:
            text = "scan stamps jumped back (a looping bag?): waiting scans dropped, map kept"
            self._notices.append(Notice("time_jump", text))
        return stamp

    def _period_ns(self, stamp_ns: int) -> float | None:
        """Return the median period of clouds up to this stamp; None for the first."""
        if self._stamp_ns and stamp_ns > self._stamp_ns:
            self._gaps_ns.append(stamp_ns - self._stamp_ns)
        self._stamp_ns = stamp_ns
        return float(np.median(self._gaps_ns)) if self._gaps_ns else None

    def ready(self, now_ns: int) -> list[ReadyScan]:
        """Return scans whose pose is known, oldest first, and drop those that waited too long.
        ``now_ns``: current time on the clock of ``arrival_ns``."""
        scans = self.queue.pop_ready()
        drops = self.queue.expire(now_ns)
        while drops:
            self._report_drops(drops)
            scans += self.queue.pop_ready()
            drops = self.queue.expire(now_ns)
        return [self._with_sweep(*scan) for scan in scans]

    def _with_sweep(self, stamp: int, cloud: _Cloud, pose: Pose) -> ReadyScan:
        if cloud.times is None:
            return ReadyScan(stamp, cloud.points, pose, edges=cloud.edges)
        offsets, (first, last) = cloud.times
        poses = poses_during(self.queue.poses, stamp + first, stamp + last)
        return ReadyScan(stamp, cloud.points, pose, interpolate_sweep(offsets, pose, poses))

    def finish(self) -> None:
        """Drop all waiting scans, at the end of the input."""
        self._report_drops(self.queue.finish())

    def notices(self) -> list[Notice]:
        """Return the warnings since the last call."""
        notices, self._notices = self._notices, []
        return [Notice(reason, one_line(text)) for reason, text in notices]

    def reject(self, what: str, error: MessageError) -> None:
        """Count an unusable message and add a warning; ``what``: cloud, pose or gimbal."""
        self.rejected[f"{what}_{error.reason}"] += 1
        self._notices.append(Notice(f"{what}_{error.reason}", str(error)))

    def _add(self, buffer: PoseBuffer, pose: Pose, what: str) -> bool:
        """Add a pose, or count it as rejected; return whether it is used."""
        reason = buffer.add(pose)
        if reason is None:
            return True
        used = reason == "time_jump"
        if not used:
            self.rejected[f"{what}_{reason}"] += 1
        consequence = "older ones forgotten" if used else "ignored"
        text = f"{what} with stamp {pose.stamp_ns} ns: {reason}, {consequence}"
        self._notices.append(Notice(f"{what}_{reason}", text))
        return used

    def _report_drops(self, drops: list[Drop]) -> None:
        self._notices += [Notice(drop.reason, drop.text) for drop in drops]


def noise_notice(ratio: float, config: Config) -> Notice | None:
    """Return a warning if the observed range noise differs from the configured one, because the
    number of leaves depends on it. ``ratio``: ``ScanReport.noise_ratio``."""
    agrees = 1.0 / NOISE_RATIO_LIMIT <= ratio <= NOISE_RATIO_LIMIT
    if math.isnan(ratio) or agrees:
        return None
    configured = config.lidar.range_noise
    cause = "a setting too large makes too few cells"
    if ratio > 1.0:
        cause = "rough ground, or too many cells for a wrong setting"
    text = (
        f"points scatter about flat cells by {ratio * configured:.3g} m, but lidar.range_noise is"
        f" {configured:g} m{' and what stereo adds' * bool(config.lidar.stereo_noise)}: {cause}"
    )
    return Notice("range_noise", text)


def pose_notice(gap: tuple[float, float] | None) -> Notice | None:
    """Return a warning if scans contradict the covariances of their poses. ``gap``: from
    `Mapper.unexplained_offset`."""
    if gap is None:
        return None
    text = (
        f"scans and map differ by {gap[0]:.2g} m, poses claim {gap[1]:.2g} m:"
        " the poses' covariances are too small, or the lidar's mount or the stamps are wrong"
    )
    return Notice("pose_gap", text)
