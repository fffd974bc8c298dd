# SPDX-License-Identifier: Apache-2.0
"""Lidar scans and poses in, the quadtree map out. Computes nothing: the core does."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from quadtree_lss.core.mapping import Mapper
from quadtree_lss.messages.intake import Intake, ReadyScan
from quadtree_lss.ros.diagnostics import Diagnostics
from quadtree_lss.ros.messages import map_messages
from quadtree_lss.ros.node_runner import run
from quadtree_lss.ros.parameters import NodeParameters
from quadtree_lss.ros.problems import Problems
from quadtree_lss.ros.qos import advertise, latched, stream, subscribe
from quadtree_lss.ros.rate_limit import ChangePublisher

SCANS, POSES = "lidar/points", "nav/pose"
EXPIRY_PERIOD_S = 0.1
"""How often scans are looked at that wait while nothing arrives."""


class MappingNode(Node):
    """Takes ``lidar/points`` and ``nav/pose``, publishes ``map/cells`` and ``map/observed``."""

    def __init__(self) -> None:
        super().__init__("mapping_node", automatically_declare_parameters_from_overrides=True)
        config = NodeParameters(self).config
        self._frame = config.frames.map
        self._mapper = Mapper(config)
        self._intake = Intake(
            config,
            scan_topic=self.resolve_topic_name(SCANS),
            pose_topic=self.resolve_topic_name(POSES),
        )
        self._scans = 0
        self._sequence = 0
        self._problems = Problems(self.get_logger())
        self._diagnostics = Diagnostics(self, config.publish.diagnostics_rate, self._problems)
        self._cells = advertise(self, PointCloud2, "map/cells", latched())
        self._observed = advertise(self, OccupancyGrid, "map/observed", latched())
        self._output = ChangePublisher(self, config.publish.rate, self._publish)
        reliable = config.qos.scan_reliability == "reliable"
        scan_qos = stream(config.qos.scan_depth, reliable=reliable)
        pose_qos = stream(config.qos.pose_depth, reliable=True)
        subscribe(self, PointCloud2, SCANS, self._on_scan, scan_qos)
        self._pose_input = subscribe(
            self, PoseWithCovarianceStamped, POSES, self._on_pose, pose_qos
        )
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(EXPIRY_PERIOD_S, self._work, clock=steady)

    def _on_scan(self, message: Any, info: dict[str, int]) -> None:
        arrival_ns = time.monotonic_ns()
        self._look_for_gap(info["publication_sequence_number"])
        self._take_poses()
        self._intake.on_cloud(message, arrival_ns)
        self._work()

    def _on_pose(self, message: Any) -> None:
        self._intake.on_pose(message)
        self._take_poses()
        self._work()

    def _look_for_gap(self, number: int) -> None:
        """Scans that were sent but lost on the way, which nothing else would tell."""
        last, self._sequence = self._sequence, number
        missing = number - last - 1
        if last > 0 and missing > 0:
            text = (
                f"{missing} scans on '{self.resolve_topic_name(SCANS)}' were lost before number"
                f" {number}: best effort, or more than qos.scan_depth were waiting"
            )
            self._problems.report("scan_lost", text, missing)

    def _take_poses(self) -> None:
        """All poses that have arrived, at once.

        The executor takes one message of each topic in turn; poses come several to a scan, and
        after a pause the scans would run ahead of them and fill their queue.
        """
        source = self._pose_input
        with source.handle:
            while (taken := source.handle.take_message(source.msg_type, source.raw)) is not None:
                self._intake.on_pose(taken[0])

    def _work(self) -> None:
        """Map every scan whose pose is there; say what could not be used."""
        for scan in self._intake.ready(time.monotonic_ns()):
            self._map(scan)
        for notice in self._intake.notices():
            self._problems.report(notice.reason, notice.text)

    def _map(self, scan: ReadyScan) -> None:
        start = time.perf_counter()
        report = self._mapper.update(scan.points_lidar, scan.pose)
        map_ms = 1e3 * (time.perf_counter() - start)
        self._scans += 1
        values = {
            "scans": self._scans,
            "scan.stamp_ns": scan.stamp_ns,
            "scan.points": report.points,
            "scan.points_used": report.points_used,
            "scan.map_ms": f"{map_ms:.2f}",
            "map.leaves": report.leaves,
            "map.refused_divisions": report.refused_divisions,
            **{f"scan.dropped.{reason}": number for reason, number in report.dropped.items()},
        }
        self._diagnostics.set("mapping", values, warn=report.points_used == 0)
        self._output.changed()

    def _publish(self) -> None:
        cells, observed = map_messages(self._mapper.snapshot(), self._frame)
        self._observed.publish(observed)
        self._cells.publish(cells)


def main(args: Sequence[str] | None = None) -> int:
    """Console script ``mapping_node``."""
    return run(MappingNode, "mapping_node: lidar scans and poses to a map of planar elements", args)
