# SPDX-License-Identifier: Apache-2.0
"""Node that publishes the quadtree map; `core.mapping` computes it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PolygonStamped, TransformStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.qos import ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from visualization_msgs.msg import MarkerArray

from quadtree_lss.onboard.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.onboard.core.sensing.pose_buffer import seconds
from quadtree_lss.onboard.core.tree.checkpoint import CheckpointError
from quadtree_lss.onboard.messages import lost_points
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.intake import Intake, ReadyScan, noise_notice, pose_notice
from quadtree_lss.onboard.messages.landing_inputs import AREA, polygon_from_message
from quadtree_lss.onboard.messages.poses import check_frame
from quadtree_lss.onboard.nodes.diagnostics import (
    ERROR,
    OK,
    WARN,
    Arrivals,
    Durations,
    Status,
    failure,
)
from quadtree_lss.onboard.nodes.entry import set_waiting_for
from quadtree_lss.onboard.nodes.losses import Overload, Publishers, ScanGaps, best_effort_hint
from quadtree_lss.onboard.nodes.map_files import Checkpoints, MapFileError, load, save
from quadtree_lss.onboard.nodes.markers import MarkerPublisher, cell_markers
from quadtree_lss.onboard.nodes.node_runner import BaseNode, run
from quadtree_lss.onboard.nodes.publishing import ChangePublisher, MapStamps
from quadtree_lss.onboard.nodes.qos import (
    OnDemandGroup,
    advertise,
    latched,
    serve,
    steady_timer,
    stream,
    subscribe,
    subscribe_any_durability,
    take_waiting,
)
from quadtree_lss.onboard.nodes.ros_messages import (
    POSE_KINDS,
    cloud_message,
    header_message,
    message_maker,
    pose_message,
    transforms_type,
)

GIMBAL, CAMERA, TRANSFORMS = "lidar/gimbal", "depth/camera_info", "/tf_static"
SCAN_DEPTH, POSE_DEPTH = 50, 200
"""Queue depths of the middleware: 2.5 s of scans at 20 Hz, 1 s of poses at 200 Hz."""
CHECK_PERIOD_S = 0.1
"""Period of reading poses and mapping waiting scans while no scan comes."""


class MappingNode(BaseNode):
    """Subscribe to scans, poses and gimbal angles, publish the map; see ``msg_docs``."""

    def __init__(self) -> None:
        super().__init__("mapping_node")
        config = self._config
        self._frame = config.frames.map
        self._scans = self._divisions_refused = 0
        self._logged_first = False
        self._failed = ""
        self._points_dropped: Counter[str] = Counter()
        self._report: ScanReport | None = None
        self._map_ms, self._publish_ms, self._delays = Durations(), Durations(), Durations()
        self._mapper, self._stamps = Mapper(config), MapStamps()
        depth = config.lidar.source == "depth"
        self._scan_kind = Image if depth else PointCloud2
        self._pose_kind = POSE_KINDS[config.pose.source]
        names = {
            "scan": "depth/image" if depth else "lidar/points",
            "pose": f"nav/{config.pose.source}",
            "gimbal": GIMBAL,
        }
        self._topics = {key: self.resolve_topic_name(name) for key, name in names.items()}
        self._arrived = {"scan": Arrivals(), "pose": Arrivals()}
        if config.mount.source == "gimbal":
            self._arrived["gimbal"] = Arrivals()
        topics = {f"{key}_topic": name for key, name in self._topics.items()}
        self._intake = Intake(config, **topics)
        self._gaps = ScanGaps(self._topics["scan"], self._problems)
        self._overload = Overload(self._topics["scan"], self._problems)
        effect = "all are used, and scans are mapped between poses of different publishers"
        self._pose_publishers = Publishers(
            self._topics["pose"], "pose_publishers", effect, self._problems
        )
        self._cells = advertise(self, PointCloud2, "map/cells", latched())
        self._observed = advertise(self, OccupancyGrid, "map/observed", latched())
        self._markers = MarkerPublisher(
            self,
            advertise(self, MarkerArray, "map/markers", latched()),
            lambda: cell_markers(self._mapper.snapshot(), self._frame),
        )
        self._output = ChangePublisher(self, config.publish.rate, self._publish)
        self._checkpoints = Checkpoints(config.checkpoint.path)
        set_waiting_for(f"checkpoint.path {config.checkpoint.path}")
        self._restore_checkpoint()
        serve(self, "reset", self._reset)
        serve(self, "save_map", self._save_map)
        serve(self, "load_map", self._load_map)
        self._best_effort = self._subscribe_scans()
        self._pose_sources = self._subscribe_poses()
        steady_timer(self, CHECK_PERIOD_S, self._check)
        self._announce()

    def finish(self) -> None:
        """Write the last changes to the checkpoint."""
        if error := self._checkpoints.close(self._mapper):
            self.get_logger().error(f"{error}; the last changes of the map are lost")

    def _subscribe_scans(self) -> bool:
        """Subscribe to scans, camera info and area; return whether scans are best effort."""
        raw = self._scan_kind is PointCloud2
        scans = subscribe(
            self,
            self._scan_kind,
            self._topics["scan"],
            self._on_scan,
            stream(SCAN_DEPTH, reliable=False),
            self._gaps.on_publishers,
            raw=raw,
        )
        if self._scan_kind is Image:
            profile = stream(1, reliable=False)
            subscribe(self, CameraInfo, CAMERA, self._intake.on_camera_info, profile)
        if self._config.domain.follow == "area":
            subscribe_any_durability(self, PolygonStamped, f"landing/{AREA}", self._on_area)
        return scans.qos_profile.reliability is ReliabilityPolicy.BEST_EFFORT

    def _subscribe_poses(self) -> list[tuple[Subscription, Callable[[Any], None]]]:
        """Subscribe to poses and to the mount of the lidar. Return the subscriptions that wake the
        node only while a scan waits for a pose, each with the function that handles its messages.
        """
        profile = stream(POSE_DEPTH, reliable=True)
        group = OnDemandGroup(lambda: len(self._intake.queue) > 0)
        callback = partial(self._handle_and_map, self._on_pose)
        poses = subscribe(
            self, self._pose_kind, self._topics["pose"], callback, profile, group=group, raw=True
        )
        sources = [(poses, self._on_pose)]
        if self._config.mount.source == "gimbal":
            callback = partial(self._handle_and_map, self._on_gimbal)
            gimbal = subscribe(self, TransformStamped, GIMBAL, callback, profile, group=group)
            sources.append((gimbal, self._on_gimbal))
        if self._config.mount.source == "tf":
            # The profile of tf2's listeners: broadcasters keep transforms for late subscribers.
            callback = partial(self._handle_and_map, self._intake.on_transforms)
            subscribe(self, transforms_type(), TRANSFORMS, callback, latched(100))
        return sources

    def _restore_checkpoint(self) -> None:
        try:
            if text := self._checkpoints.restore(self._mapper):
                self.get_logger().info(text)
        except MapFileError as error:
            self._problems.report("checkpoint", str(error))
        if self._mapper.stamp_ns:
            self._output.changed()

    def _on_scan(self, message: Any, info: dict[str, int]) -> None:
        arrival_ns = time.monotonic_ns()
        self._arrived["scan"].add()
        self._gaps.on_scan(info["publication_sequence_number"])
        self._read_poses()
        work_ms = self._map_ms.last + self._publish_ms.last
        if self._overload.admits(info["received_timestamp"], self._config, work_ms):
            try:
                raw = isinstance(message, bytes)  # clouds, not depth images
                scan = cloud_message(message) if raw else message
                self._intake.on_cloud(scan, arrival_ns)
            except MessageError as error:
                self._intake.reject("cloud", error)
        self._check()

    def _handle_and_map(self, handle: Callable[[Any], None], message: Any) -> None:
        """Handle a message and map the scans that waited for it."""
        handle(message)
        self._read_poses()
        self._map_ready_scans()

    def _on_area(self, message: Any) -> None:
        try:
            check_frame(message.header.frame_id, self._frame, "polygon")
            self._mapper.set_area(polygon_from_message(message))
        except MessageError as error:
            text = f"landing/{AREA}: {error}; the domain follows the previous area"
            self._problems.report(f"{AREA}_{error.reason}", text)

    def _on_pose(self, raw: bytes) -> None:
        self._arrived["pose"].add()
        try:
            self._intake.on_pose(pose_message(raw, self._pose_kind))
        except MessageError as error:
            self._intake.reject("pose", error)

    def _on_gimbal(self, message: Any) -> None:
        self._arrived["gimbal"].add()
        self._intake.on_gimbal(message)

    def _read_poses(self) -> None:
        """Read all poses and gimbal angles that have arrived. The executor serves one message per
        topic in turn, so that after a pause scans would overtake the more frequent poses."""
        for source, handle in self._pose_sources:
            for message in take_waiting(source):
                handle(message)
                if len(self._intake.queue):
                    self._map_ready_scans()

    def _check(self) -> None:
        """Map scans, write a checkpoint if due; after each scan, and periodically without scans."""
        self._read_poses()
        self._map_ready_scans()
        set_waiting_for(self._missing_inputs())
        if error := self._checkpoints.write_if_due(self._mapper):
            self._problems.report("checkpoint", error)

    def _missing_inputs(self) -> str:
        """Return the inputs that the first mapped scan waits for; empty after it."""
        if self._scans:
            return ""
        silent = [self._topics[key] for key, seen in self._arrived.items() if not seen.count]
        if silent:
            numbers = [f"'{n}' (publishers known: {self.count_publishers(n)})" for n in silent]
            text, topic = " and ".join(numbers), self._topics["scan"]
            sent = self._best_effort and topic in silent and self._gaps.publishers.number
            return text + (best_effort_hint(topic) if sent else "")
        dropped = [f"{n} dropped: {why}" for why, n in self._intake.dropped.items() if n]
        waiting = f"{len(self._intake.queue)} wait for a pose at their stamp"
        return f"a scan that can be mapped ({', '.join([waiting, *dropped])})"

    def _map_ready_scans(self) -> None:
        """Map every scan whose pose is known, and report rejected inputs."""
        try:
            for scan in self._intake.ready(time.monotonic_ns()):
                self._map(scan)
        except Exception as error:
            self._fail(error)
        for notice in self._intake.notices():
            self._problems.report(notice.reason, notice.text)

    def _fail(self, error: Exception) -> None:
        """Recover from an exception that may have left the map inconsistent: restore the
        checkpoint; without one keep the map if it passes the checks, else start with an empty map.
        """
        failed, state = failure("a scan", error, self.get_logger()), self._mapper.export_state()
        self._mapper.reset()
        self._restore_checkpoint()
        effect = "the map is that of the checkpoint"
        if not self._mapper.stamp_ns:
            try:
                self._mapper.import_state(state)
                effect = "the map is consistent and kept"
            except CheckpointError:
                effect = "the map was emptied"
        self._failed = f"{failed}; {effect}"
        self._problems.report("scan_failed", self._failed)
        self._report = None
        self._map_changed()

    def _map(self, scan: ReadyScan) -> None:
        start = time.perf_counter()
        report = self._mapper.update(scan.points_lidar, scan.pose, scan.sweep)
        self._map_ms.add(1e3 * (time.perf_counter() - start))
        self._scans += 1
        self._report, self._failed = report, ""
        if report.points_used and not self._logged_first:
            self._logged_first = True
            self.get_logger().info(
                f"first scan mapped: {seconds(report.stamp_ns)}, {report.points_used} of"
                f" {report.points} points, {report.leaves} leaves"
            )
        self._divisions_refused += report.refused_divisions
        self._points_dropped.update(scan.lost(report.dropped))
        if unused := lost_points.unused_points_text(report, self._mapper.domain):
            self._problems.report(lost_points.NO_POINTS_USED, unused)
        if overruled := lost_points.overruled_text(report):
            self._problems.report(lost_points.MAP_OVERRULED, overruled)
        self._map_changed(report.points_used > 0)

    def _map_changed(self, content: bool = True) -> None:
        self._stamps.content_changed |= content
        self._output.changed()
        self._markers.changed = True
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
            self._checkpoints.remove()
        except MapFileError as error:  # the map is empty nevertheless
            self._problems.report("checkpoint", f"checkpoint {error}")
        return "map emptied"

    def _publish(self) -> None:
        start = time.perf_counter()
        snapshot = self._mapper.snapshot()
        snapshot = replace(snapshot, stamp_ns=self._stamps.next(snapshot.stamp_ns))
        (_, cells), (_, observed) = message_maker(self._frame).of_map(snapshot)
        self._observed.publish(observed)
        self._cells.publish(cells)
        self._publish_ms.add(1e3 * (time.perf_counter() - start))
        if self._report is not None:  # not a map from a file
            self._delays.add(1e3 * self._age(self._mapper.stamp_ns))

    def _collect(self, status: Status) -> None:
        config, report = self._config, self._report
        # Polled, because events of the poses' group are handled only while a scan waits.
        self._pose_publishers.changed(self.count_publishers(self._topics["pose"]))
        self._pose_publishers.add_warning(status)
        self._gaps.publishers.add_warning(status)
        for key, arrivals in self._arrived.items():
            status.check_age(key, self._topics[key], arrivals, config.diagnostics)
        other = "pose" if config.pose.source == "odometry" else "odometry"
        unused = self.resolve_topic_name(f"nav/{other}")
        if not self._arrived["pose"].count and self.count_publishers(unused):
            status.note(WARN, f"'{unused}' is published: set pose.source to {other} to use it")
        wait, latency = self._overload.waits.pop_span(), self._delays.pop_span()
        status.check_delay("scans wait to be mapped for", wait, config.diagnostics)
        text = "delay of maps, by the scans' stamps and this node's clock:"
        status.check_delay(text, latency, config.diagnostics)
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
                "map_ms": self._map_ms.pop_span(),
                "publish_ms": self._publish_ms.pop_span(),
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
            if missing := self._missing_inputs():
                status.note(WARN, f"waiting for {missing}")
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
        if noise := noise_notice(report.noise_ratio, config):
            status.note(WARN, noise.text)
        if gap := pose_notice(self._mapper.unexplained_offset()):
            status.note(WARN, gap.text)
            if gap.reason not in self._problems.counts:
                self._problems.report(gap.reason, gap.text)


def main(args: Sequence[str] | None = None) -> int:
    """Console script ``mapping_node``."""
    return run(MappingNode, "mapping_node: lidar scans and poses to a map of planar elements", args)
