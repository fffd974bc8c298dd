# SPDX-License-Identifier: Apache-2.0
"""Conversion of arrays and serialised messages to rclpy messages."""

from __future__ import annotations

from array import array
from functools import lru_cache
from importlib import import_module
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message
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


def packed(values: NDArray[Any]) -> array[int]:
    """Convert to ``array.array``, which rclpy accepts without checking each element."""
    result = array(values.dtype.char)
    result.frombytes(values.view(np.uint8).data)
    return result
