# SPDX-License-Identifier: Apache-2.0
"""The message types that are read from and written to bags, and the topics they come on.

They are declared here, instead of taken from a complete ROS type store, because that one takes
0.2 s to import, longer than a short bag takes to map; ROS 1 and 2 differ in the header alone.
"""

from __future__ import annotations

from collections.abc import Collection

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from quadtree_lss.onboard.messages.landing_inputs import INSTANCE_TYPE, POINT_TYPE, POLYGON_TYPE
from quadtree_lss.onboard.messages.outputs import CLOUD_TYPE, GRID_MAP_TYPE, GRID_TYPE, POSES_TYPE

SCAN_TYPE = CLOUD_TYPE
POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
POSE_TYPES = (POSE_TYPE, ODOMETRY_TYPE)
IMAGE_TYPE, CAMERA_TYPE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
SCAN_TYPES = (SCAN_TYPE, IMAGE_TYPE)
GIMBAL_TYPE = "geometry_msgs/msg/TransformStamped"
TRANSFORMS_TYPE = "tf2_msgs/msg/TFMessage"

_HEADER = "std_msgs/Header header"
_XYZ = "float64 x\nfloat64 y\nfloat64 z"
_FIELDS = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec",
    "sensor_msgs/msg/PointField": "string name\nuint32 offset\nuint8 datatype\nuint32 count",
    "geometry_msgs/msg/Point": _XYZ,
    "geometry_msgs/msg/Vector3": _XYZ,
    "geometry_msgs/msg/Point32": "float32 x\nfloat32 y\nfloat32 z",
    "geometry_msgs/msg/Quaternion": f"{_XYZ}\nfloat64 w",
    "geometry_msgs/msg/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/msg/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/msg/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/msg/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/msg/Transform": "geometry_msgs/Vector3 translation\n"
    "geometry_msgs/Quaternion rotation",
    "geometry_msgs/msg/Polygon": "geometry_msgs/Point32[] points",
    "nav_msgs/msg/MapMetaData": "builtin_interfaces/Time map_load_time\nfloat32 resolution\n"
    "uint32 width\nuint32 height\ngeometry_msgs/Pose origin",
    "std_msgs/msg/MultiArrayDimension": "string label\nuint32 size\nuint32 stride",
    "std_msgs/msg/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset",
    "std_msgs/msg/Float32MultiArray": "std_msgs/MultiArrayLayout layout\nfloat32[] data",
    "grid_map_msgs/msg/GridMapInfo": "float64 resolution\nfloat64 length_x\nfloat64 length_y\n"
    "geometry_msgs/Pose pose",
    SCAN_TYPE: f"{_HEADER}\nuint32 height\nuint32 width\nsensor_msgs/PointField[] fields\n"
    "bool is_bigendian\nuint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense",
    IMAGE_TYPE: f"{_HEADER}\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\n"
    "uint32 step\nuint8[] data",
    "sensor_msgs/msg/RegionOfInterest": "uint32 x_offset\nuint32 y_offset\nuint32 height\n"
    "uint32 width\nbool do_rectify",
    CAMERA_TYPE: f"{_HEADER}\nuint32 height\nuint32 width\nstring distortion_model\nfloat64[] d\n"
    "float64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\nuint32 binning_y\n"
    "sensor_msgs/RegionOfInterest roi",
    POSE_TYPE: f"{_HEADER}\ngeometry_msgs/PoseWithCovariance pose",
    ODOMETRY_TYPE: f"{_HEADER}\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n"
    "geometry_msgs/TwistWithCovariance twist",
    GIMBAL_TYPE: f"{_HEADER}\nstring child_frame_id\ngeometry_msgs/Transform transform",
    TRANSFORMS_TYPE: "geometry_msgs/TransformStamped[] transforms",
    GRID_TYPE: f"{_HEADER}\nnav_msgs/MapMetaData info\nint8[] data",
    "geometry_msgs/msg/PolygonInstance": "geometry_msgs/Polygon polygon\nint64 id",
    POLYGON_TYPE: f"{_HEADER}\ngeometry_msgs/Polygon polygon",
    INSTANCE_TYPE: f"{_HEADER}\ngeometry_msgs/PolygonInstance polygon",
    POINT_TYPE: f"{_HEADER}\ngeometry_msgs/Point point",
    POSES_TYPE: f"{_HEADER}\ngeometry_msgs/Pose[] poses",
    GRID_MAP_TYPE: f"{_HEADER}\ngrid_map_msgs/GridMapInfo info\nstring[] layers\n"
    "string[] basic_layers\nstd_msgs/Float32MultiArray[] data\nuint16 outer_start_index\n"
    "uint16 inner_start_index",
}
"""By type its fields, a line each."""
OURS = (SCAN_TYPE, *POSE_TYPES, GIMBAL_TYPE, TRANSFORMS_TYPE, GRID_TYPE, POLYGON_TYPE, POINT_TYPE)
OURS = (*OURS, INSTANCE_TYPE, POSES_TYPE, GRID_MAP_TYPE, IMAGE_TYPE, CAMERA_TYPE)


def typestore(ros1: bool, wanted: Collection[str] = OURS) -> Typestore:
    """Decoder of the types above as ROS 1 or ROS 2 serialises them. ``ros1``: which of them.
    ``wanted``: types that matter: each takes milliseconds to declare."""
    header = "builtin_interfaces/Time stamp\nstring frame_id"
    fields = {**_FIELDS, "std_msgs/msg/Header": f"uint32 seq\n{header}" if ros1 else header}
    names = [name for name in wanted if name in fields]
    for name in names:  # which grows
        kinds = (line.split("[")[0].split()[0] for line in fields[name].splitlines())
        needed = (kind.replace("/", "/msg/") for kind in kinds)
        names += [kind for kind in needed if kind in fields and kind not in names]
    store = get_typestore(Stores.EMPTY)
    for name in names:
        store.register(get_types_from_msg(fields[name], name))
    return store
