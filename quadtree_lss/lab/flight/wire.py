# SPDX-License-Identifier: Apache-2.0
"""What a flight sends as messages, of rclpy's classes or of those of bags."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.lab.flight.flight import Sent
from quadtree_lss.onboard.arrays import Array

KINDS = {
    "nav/pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "lidar/points": "sensor_msgs/msg/PointCloud2",
    "landing/dispersion": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "landing/area": "geometry_msgs/msg/PolygonStamped",
    "landing/keep_out": "geometry_msgs/msg/PolygonStamped",
    "landing/target": "geometry_msgs/msg/PointStamped",
}
FLOAT32 = 7


class Wire:
    """Builds the messages.

    Args:
        types: Class by name, such as ``geometry_msgs/msg/Point``.
        pack: What the classes take as an array of uint8.
        frame: Of the map.
    """

    def __init__(
        self,
        types: Mapping[str, Callable[..., Any]],
        pack: Callable[[NDArray[np.uint8]], Any],
        frame: str,
    ) -> None:
        self._types, self._pack, self._frame = types, pack, frame

    def message(self, sent: Sent) -> Any:
        """The message of what was sent."""
        make = {
            "nav/pose": self._pose,
            "lidar/points": self._cloud,
            "landing/target": self._point,
            "landing/dispersion": self._dispersion,
        }.get(sent.topic, self._polygon)
        return make(sent)

    def _make(self, kind: str, /, **values: Any) -> Any:
        return self._types[kind](**values)

    def _header(self, stamp_ns: int, frame: str) -> Any:
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        stamp = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _stamped(self, sent: Sent, **values: Any) -> Any:
        header = self._header(sent.stamp_ns, self._frame)
        return self._make(KINDS[sent.topic], header=header, **values)

    def _place(self, kind: str, xyz: Any) -> Any:
        x, y, z = (float(value) for value in xyz)
        return self._make(kind, x=x, y=y, z=z)

    def _pose(self, sent: Sent) -> Any:
        return self._with_covariance(sent, *sent.value)

    def _dispersion(self, sent: Sent) -> Any:
        covariance = np.diag([*sent.value, 0.0, 0.0, 0.0, np.inf])  # at any heading
        return self._with_covariance(sent, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), covariance)

    def _with_covariance(self, sent: Sent, position: Array, xyzw: Array, covariance: Array) -> Any:
        x, y, z, w = (float(value) for value in xyzw)
        pose = self._make(
            "geometry_msgs/msg/Pose",
            position=self._place("geometry_msgs/msg/Point", position),
            orientation=self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )
        kind = "geometry_msgs/msg/PoseWithCovariance"
        return self._stamped(sent, pose=self._make(kind, pose=pose, covariance=covariance.ravel()))

    def _point(self, sent: Sent) -> Any:
        return self._stamped(sent, point=self._place("geometry_msgs/msg/Point", sent.value))

    def _polygon(self, sent: Sent) -> Any:
        points = [self._place("geometry_msgs/msg/Point32", (x, y, 0.0)) for x, y in sent.value]
        return self._stamped(sent, polygon=self._make("geometry_msgs/msg/Polygon", points=points))

    def _cloud(self, sent: Sent) -> Any:
        points = sent.value
        height, width, _ = points.shape
        values = np.ascontiguousarray(points, "<f4").view(np.uint8).reshape(-1)
        field = "sensor_msgs/msg/PointField"
        return self._make(
            KINDS[sent.topic],
            header=self._header(sent.stamp_ns, "lidar"),
            height=height,
            width=width,
            fields=[
                self._make(field, name=name, offset=4 * k, datatype=FLOAT32, count=1)
                for k, name in enumerate("xyz")
            ],
            is_bigendian=False,
            point_step=12,
            row_step=12 * width,
            data=self._pack(values),
            is_dense=bool(np.isfinite(points).all()),
        )
