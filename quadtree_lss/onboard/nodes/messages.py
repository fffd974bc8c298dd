# SPDX-License-Identifier: Apache-2.0
"""Arrays to rclpy messages, filled through ``array.array``, which rclpy takes unlooked."""

from __future__ import annotations

from array import array
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import (
    Point,
    Point32,
    PointStamped,
    Polygon,
    PolygonStamped,
    Pose,
    PoseArray,
    PoseWithCovariance,
    PoseWithCovarianceStamped,
    Quaternion,
)
from nav_msgs.msg import MapMetaData, OccupancyGrid
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Float32MultiArray, Header, MultiArrayDimension, MultiArrayLayout

from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.outputs import MessageMaker, cloud_records, map_from_messages

if TYPE_CHECKING:  # the sites' modules are slow to load, and mapping_node needs none
    from quadtree_lss.onboard.core.landing.sites import LandingAssessment

__all__ = [
    "GridMap",
    "TYPES",
    "cloud_records",
    "grid_map_message",
    "header_message",
    "landing_messages",
    "map_from_messages",
    "map_messages",
    "message_maker",
    "packed",
    "target_messages",
    "time_message",
]

TYPES = {
    "builtin_interfaces/msg/Time": Time,
    "geometry_msgs/msg/Point": Point,
    "geometry_msgs/msg/Point32": Point32,
    "geometry_msgs/msg/PointStamped": PointStamped,
    "geometry_msgs/msg/Polygon": Polygon,
    "geometry_msgs/msg/PolygonStamped": PolygonStamped,
    "geometry_msgs/msg/Pose": Pose,
    "geometry_msgs/msg/PoseArray": PoseArray,
    "geometry_msgs/msg/PoseWithCovariance": PoseWithCovariance,
    "geometry_msgs/msg/PoseWithCovarianceStamped": PoseWithCovarianceStamped,
    "geometry_msgs/msg/Quaternion": Quaternion,
    "nav_msgs/msg/MapMetaData": MapMetaData,
    "nav_msgs/msg/OccupancyGrid": OccupancyGrid,
    "sensor_msgs/msg/PointCloud2": PointCloud2,
    "sensor_msgs/msg/PointField": PointField,
    "std_msgs/msg/Float32MultiArray": Float32MultiArray,
    "std_msgs/msg/Header": Header,
    "std_msgs/msg/MultiArrayDimension": MultiArrayDimension,
    "std_msgs/msg/MultiArrayLayout": MultiArrayLayout,
}

try:  # no part of a bare ROS
    from grid_map_msgs.msg import GridMap, GridMapInfo
except ImportError:
    GridMap = None
else:
    TYPES |= {"grid_map_msgs/msg/GridMap": GridMap, "grid_map_msgs/msg/GridMapInfo": GridMapInfo}


@lru_cache(4)
def message_maker(frame: str) -> MessageMaker:
    """Builder of the output messages in a frame."""
    return MessageMaker(TYPES, packed, frame)


def map_messages(cells: CellMap, frame: str) -> tuple[PointCloud2, OccupancyGrid]:
    """``map/cells`` and ``map/observed``."""
    (_, cloud), (_, grid) = message_maker(frame).of_map(cells)
    return cloud, grid


def landing_messages(assessment: LandingAssessment, frame: str) -> dict[str, Any]:
    """The ``landing/`` topics other than the target's by relative name, as they are sent.

    Args:
        assessment: What they tell.
        frame: Of the map.
    """
    return dict(message_maker(frame).of_ground(assessment))


def grid_map_message(assessment: LandingAssessment, frame: str) -> Any:
    """``landing/grid_map``, where `GridMap` is not None."""
    return message_maker(frame).grid_map(assessment)


def target_messages(assessment: LandingAssessment, frame: str, age: float) -> dict[str, Any]:
    """``landing/selected`` and ``landing/status``."""
    return dict(message_maker(frame).of_target(assessment, age))


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
