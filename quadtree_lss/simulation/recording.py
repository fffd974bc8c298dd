# SPDX-License-Identifier: Apache-2.0
"""Writing scans and poses as a ROS 2 bag, without ROS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

SCAN_TOPIC = "/lidar/points"
POSE_TOPIC = "/nav/pose"
_FLOAT32 = 7  # sensor_msgs/PointField


class BagRecorder:
    """Context manager that records ``/lidar/points`` and ``/nav/pose`` into a new mcap bag."""

    def __init__(self, path: Path, *, map_frame: str = "map", lidar_frame: str = "lidar") -> None:
        """Prepare a bag at ``path``, which must not exist."""
        self._store = get_typestore(Stores.ROS2_JAZZY)
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._map_frame, self._lidar_frame = map_frame, lidar_frame

    def __enter__(self) -> BagRecorder:
        """Open the bag and declare the topics."""
        self._writer.open()
        cloud, pose = "sensor_msgs/msg/PointCloud2", "geometry_msgs/msg/PoseWithCovarianceStamped"
        self._scans = self._writer.add_connection(SCAN_TOPIC, cloud, typestore=self._store)
        self._poses = self._writer.add_connection(POSE_TOPIC, pose, typestore=self._store)
        return self

    def __exit__(self, *_: object) -> None:
        """Finish the bag."""
        self._writer.close()

    def _type(self, name: str) -> Any:
        return self._store.types[name]

    def _header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self._type("builtin_interfaces/msg/Time")(
            sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9
        )
        return self._type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame)

    def scan(self, stamp_ns: int, points_lidar: NDArray[np.float64], received_ns: int) -> None:
        """Write an organised cloud (H, W, 3): x, y, z float32, NaN = no return."""
        height, width, _ = points_lidar.shape
        field = self._type("sensor_msgs/msg/PointField")
        data = np.ascontiguousarray(points_lidar, "<f4").view(np.uint8).reshape(-1)
        message = self._type("sensor_msgs/msg/PointCloud2")(
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
        self._write(self._scans, received_ns, message)

    def pose(
        self,
        stamp_ns: int,
        position_map: NDArray[np.float64],
        quaternion_xyzw: NDArray[np.float64],
        covariance: NDArray[np.float64],
        received_ns: int,
    ) -> None:
        """Write the lidar's pose in the map with its covariance (6, 6)."""
        x, y, z = (float(value) for value in position_map)
        qx, qy, qz, qw = (float(value) for value in quaternion_xyzw)
        pose = self._type("geometry_msgs/msg/Pose")(
            position=self._type("geometry_msgs/msg/Point")(x=x, y=y, z=z),
            orientation=self._type("geometry_msgs/msg/Quaternion")(x=qx, y=qy, z=qz, w=qw),
        )
        with_covariance = self._type("geometry_msgs/msg/PoseWithCovariance")(
            pose=pose, covariance=np.ascontiguousarray(covariance, np.float64).reshape(36)
        )
        message = self._type("geometry_msgs/msg/PoseWithCovarianceStamped")(
            header=self._header(stamp_ns, self._map_frame), pose=with_covariance
        )
        self._write(self._poses, received_ns, message)

    def _write(self, connection: Any, received_ns: int, message: Any) -> None:
        raw = self._store.serialize_cdr(message, connection.msgtype)
        self._writer.write(connection, received_ns, raw)
