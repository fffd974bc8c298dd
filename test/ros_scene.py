# SPDX-License-Identifier: Apache-2.0
"""Scans and poses of a lidar hovering over a field with one block, for the node tests."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2

from quadtree_lss.lab.live.listener import Listener
from quadtree_lss.lab.simulation.recording import POSE_TOPIC, SCAN_TOPIC, Messages, recorded
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.nodes.qos import stream
from quadtree_lss.onboard.nodes.ros_messages import TYPES, header_message, message_maker, packed

OK, WARN, ERROR = (DiagnosticStatus.OK,), (DiagnosticStatus.WARN,), (DiagnosticStatus.ERROR,)
MAKE = Messages(TYPES, packed)  # of rclpy's classes
START_NS = 1_700_000_000_000_000_000
SCAN_NS, POSE_NS = 100_000_000, 37_000_000
POSITION = np.array([0.0, 0.0, 100.0])
DOWN_XYZW = np.array([1.0, 0.0, 0.0, 0.0])  # half a turn about x: boresight down, x stays x
ROTATION = np.diag([1.0, -1.0, -1.0])
COVARIANCE = np.diag([1e-4, 1e-4, 1e-4, 1e-9, 1e-9, 1e-9])
BLOCK = (4.0, 7.0, -7.0, -4.0)  # xmin, xmax, ymin, ymax, m; one metre high


class Stamped(NamedTuple):
    """A scan with its points (H, W, 3) in lidar axes, or a pose without."""

    stamp_ns: int
    points_lidar: NDArray[np.float64] | None


def events(scans: int, seed: int = 1) -> Iterator[Stamped]:
    """Scans and poses in the order of their stamps; scans lie between poses, none before one."""
    rng = np.random.default_rng(seed)
    last = START_NS + (scans - 1) * SCAN_NS
    pose_ns, scan_ns = START_NS - POSE_NS // 2, START_NS
    while pose_ns <= last + POSE_NS:
        while scan_ns < pose_ns and scan_ns <= last:
            yield Stamped(scan_ns, _scan(rng))
            scan_ns += SCAN_NS
        yield Stamped(pose_ns, None)
        pose_ns += POSE_NS


def last_scan_ns(scans: int) -> int:
    """Stamp of the last scan of ``events``."""
    return START_NS + (scans - 1) * SCAN_NS


def _scan(rng: np.random.Generator) -> NDArray[np.float64]:
    side = np.linspace(-15.5, 15.5, 64)
    x, y = np.meshgrid(side, side[::-1])
    x, y = x + rng.uniform(-0.2, 0.2, x.shape), y + rng.uniform(-0.2, 0.2, y.shape)
    on_block = (x > BLOCK[0]) & (x < BLOCK[1]) & (y > BLOCK[2]) & (y < BLOCK[3])
    z = 0.02 * x + on_block + rng.normal(0.0, 0.02, x.shape)
    points_map = np.stack([x, y, z], axis=-1)
    return (points_map - POSITION) @ ROTATION


def mapped(config: Config, scans: int) -> Mapper:
    """Return a mapper with so many of the scans, at exact poses."""
    mapper = Mapper(config)
    for event in events(scans):
        if event.points_lidar is not None:
            mapper.update(event.points_lidar, Pose(event.stamp_ns, POSITION, ROTATION, COVARIANCE))
    return mapper


def map_messages(cells: CellMap, frame: str) -> list[bytes]:
    """Serialise ``map/cells`` and ``map/observed``."""
    return [serialize_message(message) for _, message in message_maker(frame).of_map(cells)]


def write_bag(path: Path, scans: int) -> None:
    """The events as a bag."""
    make = Messages()
    with recorded(path) as write:
        for event in events(scans):
            if event.points_lidar is None:
                pose = make.pose(event.stamp_ns, POSITION, DOWN_XYZW, COVARIANCE)
                write(POSE_TOPIC, event.stamp_ns + 1_000_000, pose)
            else:
                scan = make.scan(event.stamp_ns, event.points_lidar)
                write(SCAN_TOPIC, event.stamp_ns + 10_000_000, scan)


cloud = MAKE.scan


def pose(stamp_ns: int) -> PoseWithCovarianceStamped:
    """Pose of the hovering lidar."""
    return MAKE.pose(stamp_ns, POSITION, DOWN_XYZW, COVARIANCE)


def gimbal(stamp_ns: int, translation: tuple[float, float, float]) -> TransformStamped:
    """Lidar that looks down from a level body, ``translation`` in body axes."""
    message = TransformStamped(header=header_message(stamp_ns, "body"), child_frame_id="lidar")
    place, turn = message.transform.translation, message.transform.rotation
    place.x, place.y, place.z = translation
    turn.x, turn.y, turn.z, turn.w = DOWN_XYZW.tolist()
    return message


def level_body(stamp_ns: int, above: float) -> PoseWithCovarianceStamped:
    """Pose of a level body whose origin lies ``above`` the lidar."""
    return MAKE.pose(stamp_ns, POSITION + (0.0, 0.0, above), (0.0, 0.0, 0.0, 1.0), COVARIANCE)


class Ears(Listener):
    """Listener that fails a test if an expected message does not come."""

    def __init__(self, ros: Any, topics: Mapping[str, Any]) -> None:
        super().__init__(ros.domain, topics)
        self._ros = ros
        self.diagnostics: dict[str, DiagnosticStatus] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._keep_status, 10)

    def _keep_status(self, message: DiagnosticArray) -> None:
        with self._changed:
            self.diagnostics |= {status.name: status for status in message.status}
            self._changed.notify_all()

    def until(self, condition: Callable[..., object], *args: Any, timeout: float = 60.0) -> None:
        """Wait until ``condition(*args)`` is true."""
        came = self.wait_for(partial(condition, *args), timeout)
        assert came, f"{self.diagnostics}\n{self._ros.output()}"

    def forget(self, publisher: Any) -> None:
        """Destroy a publisher in the thread that waits for its events, as rclpy requires."""
        self._executor.create_task(self.node.destroy_publisher, publisher)

    def until_stamped(self, stamp_ns: int, *topics: str) -> None:
        """Wait until the newest message of each topic has this stamp."""
        self.until(lambda: all(self.stamp(topic) == stamp_ns for topic in topics))

    def values(self, node: str = "mapping_node") -> dict[str, str]:
        """Return the values of the last diagnostic status of a node by key."""
        status = self.diagnostics.get(node)
        return {} if status is None else {item.key: item.value for item in status.values}

    def has(self, key: str, number: int, node: str = "mapping_node") -> bool:
        """Return whether a diagnostic value is this number."""
        return self.values(node).get(key) == str(number)

    def at_least(self, key: str, number: int, node: str = "mapping_node") -> bool:
        """Return whether a diagnostic value is this number or more."""
        return int(self.values(node).get(key, 0)) >= number

    def told(self, node: str, levels: Sequence[bytes], *words: str) -> bool:
        """Return whether the last status of a node has one of the levels and all these words."""
        status = self.diagnostics.get(node)
        found = status is not None and all(word in status.message for word in words)
        return found and (not levels or status.level in levels)


class Sensors:
    """Publishers of scans and poses, matched with their subscribers."""

    def __init__(self, listener: Ears) -> None:
        node, profile = listener.node, stream(100, reliable=True)
        self.scans = node.create_publisher(PointCloud2, "lidar/points", profile)
        self.poses = node.create_publisher(PoseWithCovarianceStamped, "nav/pose", profile)
        self._listener = listener

    def matched(self) -> Sensors:
        """Wait for the mapping node; return self."""
        for publisher in (self.scans, self.poses):
            self._listener.until(publisher.get_subscription_count, timeout=30.0)
        time.sleep(0.5)  # the subscriber's side of the match
        return self

    def map(self, scans: int, topic: str = "map/cells", **how: Any) -> int:
        """Call `publish`, and wait until the outputs have the stamp of the last scan."""
        last = self.publish(scans, **how)
        self._listener.until_stamped(last, topic)
        return last

    def publish(
        self,
        scans: int,
        *,
        offset_ns: int = 0,
        make_pose: Callable[[int], Any] = pose,
        make_cloud: Callable[[int, NDArray[np.float64]], PointCloud2] = cloud,
    ) -> int:
        """All events, somewhat faster than they were recorded; stamp of the last scan.

        Args:
            offset_ns: Added to all stamps.
            make_pose: Pose message of a stamp, or a list of them; none is sent for None.
            make_cloud: Scan message.
        """
        for event in events(scans):
            stamp = event.stamp_ns + offset_ns
            if event.points_lidar is not None:
                self.scans.publish(make_cloud(stamp, event.points_lidar))
                time.sleep(0.03)
                continue
            made = make_pose(stamp)
            for message in made if isinstance(made, list) else [made]:
                if message is not None:
                    self.poses.publish(message)
        return last_scan_ns(scans) + offset_ns
