# SPDX-License-Identifier: Apache-2.0
"""Scans and poses as ROS 2 messages and bags, without ROS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

SCAN_TOPIC = "/lidar/points"
POSE_TOPIC = "/nav/pose"
TYPES = {
    SCAN_TOPIC: "sensor_msgs/msg/PointCloud2",
    POSE_TOPIC: "geometry_msgs/msg/PoseWithCovarianceStamped",
}
_FLOAT32 = 7  # sensor_msgs/PointField


class Messages:
    """Makes messages of arrays."""

    def __init__(self, *, map_frame: str = "map", lidar_frame: str = "lidar") -> None:
        self.types = get_typestore(Stores.ROS2_JAZZY)
        self._map_frame, self._lidar_frame = map_frame, lidar_frame

    def _type(self, name: str) -> Any:
        return self.types.types[name]

    def _header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self._type("builtin_interfaces/msg/Time")(
            sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        return self._type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame)

    def scan(self, stamp_ns: int, points_lidar: NDArray[np.float64]) -> Any:
        """An organised cloud (H, W, 3): x, y, z float32, NaN = no return."""
        height, width, _ = points_lidar.shape
        field = self._type("sensor_msgs/msg/PointField")
        data = np.ascontiguousarray(points_lidar, "<f4").view(np.uint8).reshape(-1)
        return self._type("sensor_msgs/msg/PointCloud2")(
            header=self._header(stamp_ns, self._lidar_frame),
            height=height,
            width=width,
            fields=[
                field(name=name, offset=4 * k, datatype=_FLOAT32, count=1)
                for k, name in enumerate("xyz")
            ],
            is_bigendian=False,
            point_step=12,
            row_step=12 * width,
            data=data,
            is_dense=bool(np.isfinite(points_lidar).all()),
        )

    def pose(
        self,
        stamp_ns: int,
        position_map: NDArray[np.float64],
        quaternion_xyzw: NDArray[np.float64],
        covariance: NDArray[np.float64],
    ) -> Any:
        """The lidar's pose in the map with its covariance (6, 6)."""
        x, y, z = (float(value) for value in position_map)
        qx, qy, qz, qw = (float(value) for value in quaternion_xyzw)
        pose = self._type("geometry_msgs/msg/Pose")(
            position=self._type("geometry_msgs/msg/Point")(x=x, y=y, z=z),
            orientation=self._type("geometry_msgs/msg/Quaternion")(x=qx, y=qy, z=qz, w=qw),
        )
        with_covariance = self._type("geometry_msgs/msg/PoseWithCovariance")(
            pose=pose, covariance=np.ascontiguousarray(covariance, np.float64).reshape(36)
        )
        return self._type("geometry_msgs/msg/PoseWithCovarianceStamped")(
            header=self._header(stamp_ns, self._map_frame), pose=with_covariance
        )


class BagRecorder:
    """Context manager that records messages of `TYPES` into a new mcap bag."""

    def __init__(self, path: Path, messages: Messages) -> None:
        """Prepare a bag at ``path``, which must not exist."""
        self._store = messages.types
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)

    def __enter__(self) -> BagRecorder:
        """Open the bag and declare the topics."""
        self._writer.open()
        self._topics = {
            topic: self._writer.add_connection(topic, kind, typestore=self._store)
            for topic, kind in TYPES.items()
        }
        return self

    def __exit__(self, *_: object) -> None:
        """Finish the bag."""
        self._writer.close()

    def write(self, topic: str, received_ns: int, message: Any) -> None:
        """Write one message."""
        connection = self._topics[topic]
        raw = self._store.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, received_ns, raw)
