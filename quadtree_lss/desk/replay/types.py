# SPDX-License-Identifier: Apache-2.0
"""The message types that are read from and written to bags.

They are declared here, instead of taken from a complete ROS type store, because that one takes
longer to import than a short bag takes to map; and ROS 1 and 2 differ in the header alone.
"""

from __future__ import annotations

from collections.abc import Collection

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from quadtree_lss.onboard.messages.landing_inputs import POINT_TYPE, POLYGON_TYPE
from quadtree_lss.onboard.messages.outputs import CLOUD_TYPE, GRID_MAP_TYPE, GRID_TYPE, POSES_TYPE

SCAN_TYPE = CLOUD_TYPE
POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
POSE_TYPES = (POSE_TYPE, ODOMETRY_TYPE)
GIMBAL_TYPE = "geometry_msgs/msg/TransformStamped"
TRANSFORMS_TYPE = "tf2_msgs/msg/TFMessage"

_HEADER = """
MSG: std_msgs/Header
{sequence}builtin_interfaces/Time stamp
string frame_id
"""
_TIME = """
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
_POINT_FIELD = """
MSG: sensor_msgs/PointField
string name
uint32 offset
uint8 datatype
uint32 count
"""
_TRIPLE = """
MSG: geometry_msgs/{name}
float64 x
float64 y
float64 z
"""
_QUATERNION = """
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""
_POSE = """
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
"""
_POSE_WITH_COVARIANCE = """
MSG: geometry_msgs/PoseWithCovariance
geometry_msgs/Pose pose
float64[36] covariance
"""
_MAP_META_DATA = """
MSG: nav_msgs/MapMetaData
builtin_interfaces/Time map_load_time
float32 resolution
uint32 width
uint32 height
geometry_msgs/Pose origin
"""
_TRANSFORM = """
MSG: geometry_msgs/Transform
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
"""
_TRANSFORM_STAMPED = """
MSG: geometry_msgs/TransformStamped
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
"""
_TWIST_WITH_COVARIANCE = """
MSG: geometry_msgs/TwistWithCovariance
geometry_msgs/Twist twist
float64[36] covariance
"""
_TWIST = """
MSG: geometry_msgs/Twist
geometry_msgs/Vector3 linear
geometry_msgs/Vector3 angular
"""
_POINT, _VECTOR = _TRIPLE.format(name="Point"), _TRIPLE.format(name="Vector3")
_DEFINITIONS: dict[str, tuple[str, ...]] = {
    SCAN_TYPE: (
        """
std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
""",
        _POINT_FIELD,
    ),
    POSE_TYPE: (
        "std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n",
        _POSE_WITH_COVARIANCE,
        _POSE,
        _POINT,
        _QUATERNION,
    ),
    ODOMETRY_TYPE: (
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist\n",
        _POSE_WITH_COVARIANCE,
        _POSE,
        _POINT,
        _QUATERNION,
        _TWIST_WITH_COVARIANCE,
        _TWIST,
        _VECTOR,
    ),
    TRANSFORMS_TYPE: (
        "geometry_msgs/TransformStamped[] transforms\n",
        _TRANSFORM_STAMPED,
        _TRANSFORM,
        _VECTOR,
        _QUATERNION,
    ),
    GIMBAL_TYPE: (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n",
        _TRANSFORM,
        _VECTOR,
        _QUATERNION,
    ),
    GRID_TYPE: (
        "std_msgs/Header header\nnav_msgs/MapMetaData info\nint8[] data\n",
        _MAP_META_DATA,
        _POSE,
        _POINT,
        _QUATERNION,
    ),
    POLYGON_TYPE: (
        "std_msgs/Header header\ngeometry_msgs/Polygon polygon\n",
        "\nMSG: geometry_msgs/Polygon\ngeometry_msgs/Point32[] points\n",
        "\nMSG: geometry_msgs/Point32\nfloat32 x\nfloat32 y\nfloat32 z\n",
    ),
    POINT_TYPE: ("std_msgs/Header header\ngeometry_msgs/Point point\n", _POINT),
    POSES_TYPE: (
        "std_msgs/Header header\ngeometry_msgs/Pose[] poses\n",
        _POSE,
        _POINT,
        _QUATERNION,
    ),
}


_GRID_MAP = (
    "std_msgs/Header header\ngrid_map_msgs/GridMapInfo info\nstring[] layers\n"
    "string[] basic_layers\nstd_msgs/Float32MultiArray[] data\nuint16 outer_start_index\n"
    "uint16 inner_start_index\n",
    "\nMSG: grid_map_msgs/GridMapInfo\nfloat64 resolution\nfloat64 length_x\nfloat64 length_y\n"
    "geometry_msgs/Pose pose\n",
    "\nMSG: std_msgs/Float32MultiArray\nstd_msgs/MultiArrayLayout layout\nfloat32[] data\n",
    "\nMSG: std_msgs/MultiArrayLayout\nstd_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n",
    "\nMSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n",
    _POSE,
    _POINT,
    _QUATERNION,
)


def typestore(ros1: bool, wanted: Collection[str] | None = None) -> Typestore:
    """Decoder of the types above as ROS 1 or ROS 2 serialises them.

    Args:
        ros1: Which of them.
        wanted: Types that matter, None for all: each takes milliseconds to declare.
    """
    header = _HEADER.format(sequence="uint32 seq\n" if ros1 else "")
    store = get_typestore(Stores.EMPTY)
    # That of ROS 2: in ROS 1 the header is elsewhere.
    definitions = _DEFINITIONS if ros1 else _DEFINITIONS | {GRID_MAP_TYPE: _GRID_MAP}
    for name, parts in definitions.items():
        if wanted is None or name in wanted:
            text = ("=" * 80).join((*parts, header, _TIME))
            store.register(get_types_from_msg(text, name))
    return store
