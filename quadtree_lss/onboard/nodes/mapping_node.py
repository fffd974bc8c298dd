# SPDX-License-Identifier: Apache-2.0
"""Lidar scans and poses in, the quadtree map out. Computes nothing: the core does."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PolygonStamped, PoseWithCovarianceStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from quadtree_lss.onboard.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.onboard.core.sensing.pose_buffer import seconds
from quadtree_lss.onboard.core.tree.checkpoint import CheckpointError
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.intake import Intake, ReadyScan, noise_notice, pose_notice
from quadtree_lss.onboard.messages.landing_inputs import AREA, polygon_from_message
from quadtree_lss.onboard.messages.lost_points import (
    MAP_OVERRULED,
    NO_POINTS_USED,
    likely_reason,
    misplaced,
    overruled_text,
    unused_points_text,
)
from quadtree_lss.onboard.nodes.diagnostics import (
    ERROR,
    OK,
    WARN,
    Arrivals,
    Durations,
    Status,
    failure,
)
from quadtree_lss.onboard.nodes.entry import waits_for
from quadtree_lss.onboard.nodes.executor import WhenWanted, arrived, steady_timer
from quadtree_lss.onboard.nodes.files import MapFileError
from quadtree_lss.onboard.nodes.losses import Overload, Publishers, ScanGaps, best_effort_hint
from quadtree_lss.onboard.nodes.map_files import Checkpoints, load, save
from quadtree_lss.onboard.nodes.markers import MarkerPublisher, cell_markers
from quadtree_lss.onboard.nodes.node_runner import BaseNode, run
from quadtree_lss.onboard.nodes.publishing import ChangePublisher, MapStamps
from quadtree_lss.onboard.nodes.qos import (
    advertise,
    latched,
    serve,
    stream,
    subscribe,
    subscribe_twice,
)
from quadtree_lss.onboard.nodes.ros_messages import (
    cloud_message,
    header_message,
    map_messages,
    pose_message,
    transforms_type,
)

SCANS, POSES, GIMBAL = "lidar/points", "nav/pose", "lidar/gimbal"
DEPTH, CAMERA = "depth/image", "depth/camera_info"
ODOMETRY, TRANSFORMS = "nav/odometry", "/tf_static"
MAP_LATE = "by the scans' stamps and this node's clock, maps are sent after"
SCAN_DEPTH, POSE_DEPTH = 50, 200
"""What the middleware may queue: 2.5 s of scans of 20 Hz, and of poses ten times as many."""
LOOK_PERIOD_S = 0.1
"""How often poses are taken and waiting scans looked at while no scan comes."""


class MappingNode(BaseNode):
    """Takes scans, poses and gimbal angles, publishes the map; see ``msg_docs``."""

    def __init__(self) -> None:
        super().__init__("mapping_node")
        config = self._config
        self._frame = config.frames.map
        self._mapper = Mapper(config)
        odometry = config.pose.source == "odometry"
        self._pose_kind = Odometry if odometry else PoseWithCovarianceStamped
        self._scan_kind = Image if config.lidar.source == "depth" else PointCloud2
        scans = DEPTH if config.lidar.source == "depth" else SCANS
        names = {"scan": scans, "pose": ODOMETRY if odometry else POSES, "gimbal": GIMBAL}
        self._topics = {what: self.resolve_topic_name(name) for what, name in names.items()}
        topics = {f"{what}_topic": name for what, name in self._topics.items()}
        self._intake = Intake(config, **topics)
        self._gaps = ScanGaps(self._topics["scan"], self._problems)
        self._overload = Overload(self._topics["scan"], self._problems)
        effect = "they are taken as one's; scans are mapped between poses of different ones"
        self._pose_publishers = Publishers(
            self._topics["pose"], "pose_publishers", effect, self._problems
        )
        self._arrived = {"scan": Arrivals(), "pose": Arrivals()}
        if config.mount.source == "gimbal":
            self._arrived["gimbal"] = Arrivals()
        self._scans = 0
        self._first_told = False
        self._divisions_refused = 0
        self._points_dropped: Counter[str] = Counter()
        self._report: ScanReport | None = None
        self._map_ms, self._publish_ms, self._delays = Durations(), Durations(), Durations()
        self._cells = advertise(self, PointCloud2, "map/cells", latched())
        self._observed = advertise(self, OccupancyGrid, "map/observed", latched())
        self._markers = MarkerPublisher(
            self,
            advertise(self, MarkerArray, "map/markers", latched()),
            lambda: cell_markers(self._mapper.snapshot(), self._frame),
        )
        self._stamps = MapStamps()
        self._output = ChangePublisher(self, config.publish.rate, self._publish)
        self._failed = ""
        self._checkpoints = Checkpoints(config.checkpoint.path)
        waits_for(f"checkpoint.path {config.checkpoint.path}")
        self._take_up_checkpoint()
        serve(self, "reset", self._reset)
        serve(self, "save_map", self._save_map)
        serve(self, "load_map", self._load_map)
        self._subscribe()
        steady_timer(self, LOOK_PERIOD_S, self._look_around)
        self._announce()

    def finish(self) -> None:
        """Before the node ends in good order, what the checkpoint lacks is written."""
        error = self._checkpoints.close(self._mapper)
        if error is not None:
            self.get_logger().error(f"{error}; what it lacks is lost")

    def _subscribe(self) -> None:
        scan_qos = stream(SCAN_DEPTH, reliable=False)
        pose_qos = stream(POSE_DEPTH, reliable=True)
        topic, told = self._topics["scan"], self._gaps.on_publishers
        clouds = self._scan_kind is PointCloud2
        scans = subscribe(self, self._scan_kind, topic, self._on_scan, scan_qos, told, raw=clouds)
        self._best_effort = scans.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT
        if self._scan_kind is Image:
            subscribe(
                self, CameraInfo, CAMERA, self._intake.on_camera_info, stream(1, reliable=False)
            )
        if self._config.domain.follow == "area":
            subscribe_twice(self, PolygonStamped, f"landing/{AREA}", self._on_area)
        ahead = WhenWanted(lambda: len(self._intake.queue) > 0)
        poses, kind = self._topics["pose"], self._pose_kind
        take = self._and_work(self._take_pose)
        pose = subscribe(self, kind, poses, take, pose_qos, group=ahead, raw=True)
        self._ahead = [(pose, self._take_pose)]
        if self._config.mount.source == "gimbal":
            take = self._and_work(self._take_gimbal)
            gimbal = subscribe(self, TransformStamped, GIMBAL, take, pose_qos, group=ahead)
            self._ahead.append((gimbal, self._take_gimbal))
        if self._config.mount.source == "tf":
            # As tf2's own listeners: every broadcaster keeps its transforms for whoever comes late.
            kept = latched(100)
            take = self._and_work(self._intake.on_transforms)
            subscribe(self, transforms_type(), TRANSFORMS, take, kept)

    def _take_up_checkpoint(self) -> None:
        try:
            if said := self._checkpoints.take_up(self._mapper):
                self.get_logger().info(said)
        except MapFileError as error:
            self._problems.report("checkpoint", str(error))
        if self._mapper.stamp_ns:
            self._output.changed()

    def _on_scan(self, message: Any, info: dict[str, int]) -> None:
        arrival_ns = time.monotonic_ns()
        self._arrived["scan"].add()
        self._gaps.on_scan(info["publication_sequence_number"])
        self._take_ahead()
        work_ms = self._map_ms.last + self._publish_ms.last
        if self._overload.takes(info["received_timestamp"], self._config, work_ms):
            self._take_scan(message, arrival_ns)
        self._look_around()

    def _take_scan(self, message: Any, arrival_ns: int) -> None:
        """An image, or the bytes of a cloud."""
        try:
            scan = cloud_message(message) if isinstance(message, bytes) else message
        except MessageError as error:
            self._intake.reject("cloud", error)
        else:
            self._intake.on_cloud(scan, arrival_ns)

    def _and_work(self, take: Callable[[Any], None]) -> Callable[[Any], None]:
        """Callback of what scans may be waiting for."""

        def on_message(message: Any) -> None:
            take(message)
            self._take_ahead()
            self._work()

        return on_message

    def _on_area(self, message: Any) -> None:
        try:
            self._mapper.look_at(polygon_from_message(message, self._frame))
        except MessageError as error:
            text = f"landing/{AREA}: {error}; the domain lies as the one before asked for"
            self._problems.report(f"{AREA}_{error.reason}", text)

    def _take_pose(self, raw: bytes) -> None:
        self._arrived["pose"].add()
        try:
            self._intake.on_pose(pose_message(raw, self._pose_kind))
        except MessageError as error:
            self._intake.reject("pose", error)

    def _take_gimbal(self, message: Any) -> None:
        self._arrived["gimbal"].add()
        self._intake.on_gimbal(message)

    def _take_ahead(self) -> None:
        """All poses and gimbal angles that have arrived, at once.

        The executor takes one message of each topic in turn; poses come several to a scan, and
        after a pause the scans would run ahead of them and fill their queue.
        """
        for source, take in self._ahead:
            for message in arrived(source):
                take(message)
                if len(self._intake.queue):
                    self._work()

    def _look_around(self) -> None:
        """What is due with each scan, and where none comes all the same."""
        self._take_ahead()
        self._work()
        waits_for(self._lacks())
        error = self._checkpoints.work(self._mapper)
        if error is not None:
            self._problems.report("checkpoint", error)

    def _lacks(self) -> str:
        """What the first scan to be mapped takes and has not come, empty after it."""
        if self._scans:
            return ""
        silent = [self._topics[what] for what, of in self._arrived.items() if not of.count]
        if silent:
            known = "'{}' (publishers known: {})".format
            text = " and ".join(known(name, self.count_publishers(name)) for name in silent)
            topic = self._topics["scan"]
            sent = self._best_effort and topic in silent and self._gaps.publishers.number
            return text + (best_effort_hint(topic) if sent else "")
        gone = [f"{n} dropped: {why}" for why, n in self._intake.dropped.items() if n]
        waiting = f"{len(self._intake.queue)} wait for a pose at their stamp"
        return f"a scan that can be mapped ({', '.join([waiting, *gone])})"

    def _work(self) -> None:
        """Map every scan whose pose is there; say what could not be used."""
        try:
            for scan in self._intake.ready(time.monotonic_ns()):
                self._map(scan)
        except Exception as error:
            self._fail(error)
        for notice in self._intake.notices():
            self._problems.report(notice.reason, notice.text)

    def _fail(self, error: Exception) -> None:
        """A scan ended in an error, which may have left the map half changed: it goes on from its
        checkpoint, or if there is none as it is, provided that it is sound."""
        failed, state = failure("a scan", error, self.get_logger()), self._mapper.export_state()
        self._mapper.reset()
        self._take_up_checkpoint()
        how = "the map is that of the checkpoint"
        if not self._mapper.stamp_ns:
            try:
                self._mapper.import_state(state)
                how = "the map is sound and goes on"
            except CheckpointError:
                how = "the map begins anew"
        self._failed = f"{failed}; {how}"
        self._problems.report("scan_failed", self._failed)
        self._report = None
        self._map_changed()

    def _map(self, scan: ReadyScan) -> None:
        start = time.perf_counter()
        report = self._mapper.update(scan.points_lidar, scan.pose, scan.sweep)
        self._map_ms.add(1e3 * (time.perf_counter() - start))
        self._scans += 1
        self._report, self._failed = report, ""
        if report.points_used and not self._first_told:
            self._first_told = True
            self.get_logger().info(
                f"first scan mapped: {seconds(report.stamp_ns)}, {report.points_used} of"
                f" {report.points} points, {report.leaves} leaves"
            )
        self._divisions_refused += report.refused_divisions
        self._points_dropped.update(scan.lost(report.dropped))
        config = self._config
        wrong = misplaced(report)
        why = likely_reason(scan.points_lidar, scan.pose, config) if wrong else ""
        unused = unused_points_text(report, self._mapper.domain, why)
        if unused is not None:
            self._problems.report(NO_POINTS_USED, unused)
        overruled = overruled_text(report)
        if overruled is not None:
            self._problems.report(MAP_OVERRULED, overruled)
        self._map_changed(report.points_used > 0)

    def _map_changed(self, content: bool = True) -> None:
        self._stamps.content_changed |= content
        self._output.changed()
        self._markers.changed()
        self._checkpoints.changed()

    def _map_file(self) -> Path:
        path = self._config.map_file.path
        if not path:
            msg = "parameter map_file.path is not set"
            raise MapFileError(msg)
        return Path(path).absolute()

    def _save_map(self) -> str:
        path = self._map_file()
        save(path, self._mapper)
        return f"{self._mapper.leaves.count} leaves saved to {path}"

    def _load_map(self) -> str:
        path = self._map_file()
        load(path, self._mapper)
        self._report = None
        self._map_changed()
        return f"{self._mapper.leaves.count} leaves loaded from {path}"

    def _reset(self) -> str:
        self._mapper.reset()
        self._report = None
        self._stamps.reset()
        self._output.now()
        self._markers.delete_all(header_message(0, self._frame))
        try:
            self._checkpoints.forget()
        except MapFileError as error:  # the map is empty all the same
            self._problems.report("checkpoint", f"checkpoint {error}")
        return "map emptied"

    def _publish(self) -> None:
        start = time.perf_counter()
        snapshot = self._mapper.snapshot()
        snapshot = replace(snapshot, stamp_ns=self._stamps.next(snapshot.stamp_ns))
        cells, observed = map_messages(snapshot, self._frame)
        self._observed.publish(observed)
        self._cells.publish(cells)
        self._publish_ms.add(1e3 * (time.perf_counter() - start))
        latency = self._latency_ms(self._mapper.stamp_ns)
        if self._report is not None and latency is not None:  # else of a file, however old
            self._delays.add(latency)

    def _collect(self, status: Status) -> None:
        config, report = self._config, self._report
        # Not by an event: those of poses are looked at only while a scan waits.
        self._pose_publishers.changed(self.count_publishers(self._topics["pose"]))
        self._pose_publishers.judge(status)
        self._gaps.publishers.judge(status)
        for what, of in self._arrived.items():
            status.judge_age(what, self._topics[what], of, config.diagnostics)
        other = "pose" if config.pose.source == "odometry" else "odometry"
        unused = self.resolve_topic_name(f"nav/{other}")
        if not self._arrived["pose"].count and self.count_publishers(unused):
            status.note(WARN, f"'{unused}' is published: pose.source: {other} takes it")
        wait, latency = self._overload.waits.take(), self._delays.take()
        status.judge_delay("scans wait to be mapped for", wait, config.diagnostics)
        status.judge_delay(MAP_LATE, latency, config.diagnostics)
        dropped = Counter(self._intake.dropped, overload=self._overload.dropped)
        status.add(
            {
                "scans": self._scans,
                "scans.waiting": len(self._intake.queue),
                **{f"scans.dropped.{key}": n for key, n in dropped.items() if n},
                **{f"points.dropped.{key}": n for key, n in self._points_dropped.items()},
                "map.stamp_ns": self._mapper.stamp_ns,
                "map.leaves": self._mapper.leaves.count,
                "map.refused_divisions": self._divisions_refused,
                "map_ms": self._map_ms.take(),
                "publish_ms": self._publish_ms.take(),
                "wait_ms": wait,
                "latency_ms": latency,
            }
        )
        if config.checkpoint.path:
            status.add({"checkpoints": self._checkpoints.written})
        if self._failed:
            status.note(ERROR, self._failed)
        if report is None:
            status.note(OK, "no scan mapped since the start, a reset or load")
            if lack := self._lacks():
                status.note(WARN, f"waiting for {lack}")
            return
        status.note(OK, f"mapping, {self._mapper.leaves.count} leaves")
        status.add(
            {
                "scan.stamp_ns": report.stamp_ns,
                "scan.points": report.points,
                "scan.points_used": report.points_used,
                "scan.noise_ratio": report.noise_ratio,
                "scan.offset_z": report.offset,
            }
        )
        if report.points_used == 0:
            status.note(WARN, "no point of the last scan could be used")
        if self._mapper.leaves.count + 3 > config.mapping.max_cells:
            status.note(WARN, "the map is full (mapping.max_cells)")
        noise = noise_notice(report.noise_ratio, config)
        if noise is not None:
            status.note(WARN, noise.text)
        gap = pose_notice(self._mapper.pose_gap())
        if gap is not None:
            status.note(WARN, gap.text)
            if gap.reason not in self._problems.counts:
                self._problems.report(gap.reason, gap.text)


def main(args: Sequence[str] | None = None) -> int:
    """Console script ``mapping_node``."""
    return run(MappingNode, "mapping_node: lidar scans and poses to a map of planar elements", args)
