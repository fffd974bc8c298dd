# SPDX-License-Identifier: Apache-2.0
"""Arrays to rclpy messages, filled through ``array.array``, which rclpy takes unlooked."""

from __future__ import annotations

from array import array
from functools import lru_cache
from importlib import import_module
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from nav_msgs.msg import OccupancyGrid
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.outputs import MessageMaker


class _Types(dict[str, Any]):
    """Message classes by name, such as ``nav_msgs/msg/OccupancyGrid``, as they are asked for."""

    def __missing__(self, name: str) -> Any:
        package, _, kind = name.split("/")
        self[name] = found = getattr(import_module(f"{package}.msg"), kind)
        return found


TYPES = _Types()
try:  # no part of a bare ROS
    GridMap = TYPES["grid_map_msgs/msg/GridMap"]
except ImportError:
    GridMap = None


@lru_cache(4)
def message_maker(frame: str) -> MessageMaker:
    """Builder of the output messages in a frame."""
    return MessageMaker(TYPES, packed, frame)


def map_messages(cells: CellMap, frame: str) -> tuple[PointCloud2, OccupancyGrid]:
    """``map/cells`` and ``map/observed``."""
    (_, cloud), (_, grid) = message_maker(frame).of_map(cells)
    return cloud, grid


def time_message(stamp: int) -> Time:
    """Integer nanoseconds to a ROS time."""
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    return Time(sec=seconds, nanosec=nanoseconds)


def header_message(stamp: int, frame: str) -> Header:
    """Header with a stamp in nanoseconds."""
    return Header(stamp=time_message(stamp), frame_id=frame)


def packed(values: NDArray[Any]) -> array[int]:
    """What rclpy takes unlooked for an array of bytes."""
    result = array(values.dtype.char)
    result.frombytes(values.view(np.uint8).data)
    return result
