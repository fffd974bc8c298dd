# SPDX-License-Identifier: Apache-2.0
"""Conversion between arrays, rclpy messages and serialised messages."""

from __future__ import annotations

import struct
from array import array
from functools import lru_cache
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from quadtree_lss.onboard.config.settings import ConfigError
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.outputs import MessageMaker


class _Types(dict[str, Any]):
    """Message classes by name, such as ``nav_msgs/msg/OccupancyGrid``, imported on first use."""

    def __missing__(self, name: str) -> Any:
        package, _, kind = name.split("/")
        self[name] = message_class = getattr(import_module(f"{package}.msg"), kind)
        return message_class


TYPES = _Types()
POSE_KINDS: dict[str, Any] = {"pose": PoseWithCovarianceStamped, "odometry": Odometry}
"""Message classes by ``pose.source``."""
try:  # not part of a minimal ROS installation
    GridMap = TYPES["grid_map_msgs/msg/GridMap"]
except ImportError:
    GridMap = None


def transforms_type() -> Any:
    """Import ``tf2_msgs/TFMessage``, which the ROS wheels lack. Raises `ConfigError` without it."""
    try:
        return TYPES["tf2_msgs/msg/TFMessage"]
    except ImportError:
        msg = "mount.source tf needs tf2_msgs (apt install ros-jazzy-tf2-msgs): or set mount.x ..."
        raise ConfigError(msg) from None


@lru_cache(4)
def message_maker(frame: str) -> MessageMaker:
    """Return the builder of the output messages in a frame."""
    return MessageMaker(TYPES, packed, frame)


def time_message(stamp: int) -> Time:
    """Convert integer nanoseconds to a ROS time."""
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    return Time(sec=seconds, nanosec=nanoseconds)


def header_message(stamp: int, frame: str) -> Header:
    """Make a header; ``stamp`` in nanoseconds."""
    return Header(stamp=time_message(stamp), frame_id=frame)


def deserialised(raw: bytes, kind: Any) -> Any:
    """Deserialise a message. Raises `MessageError` if it is not of this type (``damaged``)."""
    try:
        return deserialize_message(raw, kind)
    except RuntimeError:  # of the middleware
        msg = f"a message of {len(raw)} bytes is not a {kind.__name__}"
        raise MessageError("damaged", msg) from None


LITTLE_ENDIAN = b"\x00\x01"
"""First bytes of serialised messages that the functions below decode; `deserialised` reads others.
"""


def _read_string(raw: bytes, offset: int) -> tuple[str, int]:
    """Return the string at ``offset``, aligned to four bytes, and the offset of its end."""
    offset += -offset % 4
    (length,) = struct.unpack_from("<I", raw, offset)
    return raw[offset + 4 : offset + 3 + length].decode(), offset + 4 + length


def pose_message(raw: bytes, kind: Any) -> Any:
    """Deserialise ``PoseWithCovarianceStamped`` or ``Odometry`` without the twist, five times as
    fast as `deserialised`, because hundreds of poses come per second. Raises `MessageError`."""
    offset, names = 12, []
    try:
        seconds, nanoseconds = struct.unpack_from("<iI", raw, 4)
        for _ in range(2 if kind is Odometry else 1):
            name, offset = _read_string(raw, offset)
            names.append(name)
        numbers = np.frombuffer(raw, "<f8", 7 + 36, offset + (4 - offset) % 8)
    except (struct.error, ValueError):
        return deserialised(raw, kind)
    if raw[:2] != LITTLE_ENDIAN:
        return deserialised(raw, kind)
    x, y, z, *q = numbers[:7].tolist()
    pose = SimpleNamespace(position=SimpleNamespace(x=x, y=y, z=z))
    pose.orientation = SimpleNamespace(x=q[0], y=q[1], z=q[2], w=q[3])
    stamp = SimpleNamespace(sec=seconds, nanosec=nanoseconds)
    message = SimpleNamespace(header=SimpleNamespace(stamp=stamp, frame_id=names[0]))
    message.pose = SimpleNamespace(pose=pose, covariance=numbers[7:])
    if len(names) > 1:
        message.child_frame_id = names[1]
    return message


def cloud_message(raw: bytes) -> Any:
    """Deserialise ``PointCloud2``, four times as fast as `deserialised`: ``data`` is a view of
    ``raw``. Raises `MessageError`."""
    fields = []
    try:
        seconds, nanoseconds = struct.unpack_from("<iI", raw, 4)
        frame, end = _read_string(raw, 12)
        height, width, count = struct.unpack_from("<3I", raw, end + -end % 4)
        end += -end % 4 + 12
        for _ in range(count):
            name, end = _read_string(raw, end)
            offset, kind, number = struct.unpack_from("<IB3xI", raw, end + -end % 4)
            end += -end % 4 + 12
            field = {"name": name, "offset": offset, "datatype": kind, "count": number}
            fields.append(SimpleNamespace(**field))
        big, point_step, row_step, size = struct.unpack_from("<B3x3I", raw, end)
        data, dense = memoryview(raw)[end + 16 : end + 16 + size], raw[end + 16 + size]
    except (struct.error, ValueError, IndexError):
        return deserialised(raw, PointCloud2)
    if raw[:2] != LITTLE_ENDIAN:
        return deserialised(raw, PointCloud2)
    stamp = SimpleNamespace(sec=seconds, nanosec=nanoseconds)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id=frame),
        height=height,
        width=width,
        fields=fields,
        is_bigendian=big > 0,
        point_step=point_step,
        row_step=row_step,
        data=data,
        is_dense=dense > 0,
    )


def packed(values: NDArray[Any]) -> array[int]:
    """Convert to ``array.array``, which rclpy accepts without checking each element."""
    result = array(values.dtype.char)
    result.frombytes(values.view(np.uint8).data)
    return result
