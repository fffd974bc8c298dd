# SPDX-License-Identifier: Apache-2.0
"""Scans, poses and landing inputs as messages of rosbags or rclpy; recording of bags."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.messages.maps import record_dtype
from quadtree_lss.onboard.messages.outputs import MessageMaker

SCAN_TOPIC, POSE_TOPIC = "/lidar/points", "/nav/pose"
CLOUD = "sensor_msgs/msg/PointCloud2"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
DEPTH_TOPIC, CAMERA_TOPIC = "/depth/image", "/depth/camera_info"
IMAGE, CAMERA = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
DEPTH_TYPES = {DEPTH_TOPIC: IMAGE, CAMERA_TOPIC: CAMERA}
TYPES = {SCAN_TOPIC: CLOUD, POSE_TOPIC: POSE}
XYZ = record_dtype(("f4", "xyz"))


class Messages(MessageMaker):
    """Make messages from arrays: of classes ``types`` by name, by default those of rosbags.
    ``pack`` converts arrays of uint8 for them; ``frame`` is the map frame."""

    def __init__(
        self,
        types: Mapping[str, Callable[..., Any]] | None = None,
        pack: Callable[[NDArray[Any]], Any] = np.asarray,
        frame: str = "map",
    ) -> None:
        types = get_typestore(Stores.ROS2_JAZZY).types if types is None else types
        super().__init__(types, pack, frame)

    def scan(self, stamp_ns: int, points_lidar: Array) -> Any:
        """Organised cloud of points (H, W, 3), float32, NaN = no return."""
        points = np.ascontiguousarray(points_lidar, "<f4").view(XYZ)[..., 0]
        cloud = self.cloud(points, stamp_ns)
        cloud.header.frame_id = "lidar"
        cloud.is_dense = bool(np.isfinite(points_lidar).all())
        return cloud

    def depth(self, stamp_ns: int, z: Array) -> Any:
        """Depth image of depths (H, W), m, NaN = no return, as 16UC1 in mm."""
        height, width = z.shape
        pixels = np.nan_to_num(np.rint(1e3 * z)).astype("<u2")
        return self._make(
            IMAGE,
            header=self._camera_header(stamp_ns),
            height=height,
            width=width,
            encoding="16UC1",
            is_bigendian=0,
            step=2 * width,
            data=self._pack(pixels.view(np.uint8).reshape(-1)),
        )

    def camera(self, stamp_ns: int, height: int, width: int, focal_length: float) -> Any:
        """CameraInfo without distortion, its principal point in the centre of the image."""
        f, middle = focal_length, (0.5 * (width - 1), 0.5 * (height - 1))
        k = np.array([f, 0.0, middle[0], 0.0, f, middle[1], 0.0, 0.0, 1.0])
        window = dict.fromkeys(("x_offset", "y_offset", "height", "width"), 0)
        return self._make(
            CAMERA,
            header=self._camera_header(stamp_ns),
            height=height,
            width=width,
            distortion_model="plumb_bob",
            d=np.zeros(5),
            k=k,
            r=np.eye(3).reshape(9),
            p=np.insert(k, (3, 6, 9), 0.0),
            binning_x=0,
            binning_y=0,
            roi=self._make("sensor_msgs/msg/RegionOfInterest", **window, do_rectify=False),
        )

    def pose(self, stamp: int, position: Any, xyzw: Any, covariance: Array) -> Any:
        """Pose in the map frame with its covariance (6, 6)."""
        matrix = np.ascontiguousarray(covariance, np.float64).reshape(36)
        return super().pose(stamp, position, xyzw, matrix)

    def point(self, stamp_ns: int, xyz: Array) -> Any:
        """Point (3,) in the map frame."""
        point, header = self._point("Point", xyz), self._header(stamp_ns)
        return self._make("geometry_msgs/msg/PointStamped", header=header, point=point)

    def polygon(self, stamp_ns: int, corners: Array, number: int | None = None) -> Any:
        """Polygon (K, 2) in the map frame; with a ``number``, a PolygonInstance."""
        points = [self._point("Point32", (x, y, 0.0)) for x, y in corners]
        polygon, kind = self._make("geometry_msgs/msg/Polygon", points=points), "Polygon"
        if number is not None:
            kind = "PolygonInstance"
            polygon = self._make(f"geometry_msgs/msg/{kind}", polygon=polygon, id=number)
        header = self._header(stamp_ns)
        return self._make(f"geometry_msgs/msg/{kind}Stamped", header=header, polygon=polygon)

    def _camera_header(self, stamp_ns: int) -> Any:
        header = self._header(stamp_ns)
        header.frame_id = "camera_depth_optical_frame"
        return header

    def _point(self, kind: str, xyz: Any) -> Any:
        x, y, z = map(float, xyz)
        return self._make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


@contextmanager
def recorded(path: Path) -> Iterator[Callable[[str, int, Any], None]]:
    """Record a new mcap bag with a function of topic, time of reception, ns, and message."""
    store, kinds = get_typestore(Stores.ROS2_JAZZY), TYPES | DEPTH_TYPES
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:

        @cache
        def connection(topic: str) -> Any:
            return writer.add_connection(topic, kinds[topic], typestore=store)

        def write(topic: str, received_ns: int, message: Any) -> None:
            raw = store.serialize_cdr(message, kinds[topic])
            writer.write(connection(topic), received_ns, raw)

        yield write
