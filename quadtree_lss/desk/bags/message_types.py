# SPDX-License-Identifier: Apache-2.0
"""Message types that are read from and written to bags."""

from __future__ import annotations

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from quadtree_lss.onboard.messages.outputs import CLOUD_TYPE, GRID_MAP_TYPE

SCAN_TYPE = CLOUD_TYPE
POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
POSE_TYPES = (POSE_TYPE, ODOMETRY_TYPE)
IMAGE_TYPE, CAMERA_TYPE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
SCAN_TYPES = (SCAN_TYPE, IMAGE_TYPE)
GIMBAL_TYPE = "geometry_msgs/msg/TransformStamped"
TRANSFORMS_TYPE = "tf2_msgs/msg/TFMessage"

HEADER_TYPE = "std_msgs/msg/Header"
HEADER = "uint32 seq\nbuiltin_interfaces/Time stamp\nstring frame_id"
"""Definition in ROS 1. Its other types are read as those of ROS 2, because only names differ."""
GRID_MAP_INFO = "float64 resolution\nfloat64 length_x\nfloat64 length_y\ngeometry_msgs/Pose pose"
GRID_MAP = """std_msgs/Header header
grid_map_msgs/GridMapInfo info
string[] layers
string[] basic_layers
std_msgs/Float32MultiArray[] data
uint16 outer_start_index
uint16 inner_start_index"""
"""Definitions in ROS 2, which rosbags lacks."""


def type_name(name: str) -> str:
    """Convert a type name of ROS 1 or DDS to ROS 2 form, ``sensor_msgs/msg/PointCloud2``."""
    parts = [part for part in name.replace("::", "/").split("/") if part not in ("msg", "dds_", "")]
    return f"{parts[0]}/msg/{parts[1].rstrip('_')}" if len(parts) == 2 else name


def typestore(ros1: bool) -> Typestore:
    """Return the decoder of messages serialised by ROS 1 or ROS 2."""
    store = get_typestore(Stores.ROS2_JAZZY)
    if ros1:
        del store.fielddefs[HEADER_TYPE], store.types[HEADER_TYPE]
        store.register(get_types_from_msg(HEADER, HEADER_TYPE))
    for name, fields in (
        ("grid_map_msgs/msg/GridMapInfo", GRID_MAP_INFO),
        (GRID_MAP_TYPE, GRID_MAP),
    ):
        store.register(get_types_from_msg(fields, name))
    return store
