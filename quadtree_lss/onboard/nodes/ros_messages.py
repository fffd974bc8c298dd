# SPDX-License-Identifier: Apache-2.0
"""Arrays to rclpy messages, through ``array.array``, which rclpy accepts without a check."""

from __future__ import annotations

import struct
from array import array
from functools import lru_cache
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Header

from quadtree_lss.onboard.config.settings import ConfigError
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.maps import CELL_FIELDS, encode_cells, encode_observed
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


def transforms_type() -> Any:
    """Import ``tf2_msgs/TFMessage``, which the ROS wheels lack. Raises `ConfigError` without it."""
    try:
        return TYPES["tf2_msgs/msg/TFMessage"]
    except ImportError:
        msg = "mount.source tf needs tf2_msgs (apt install ros-jazzy-tf2-msgs): or set mount.x ..."
        raise ConfigError(msg) from None


@lru_cache(4)
def message_maker(frame: str) -> MessageMaker:
    """Builder of the output messages in a frame."""
    return MessageMaker(TYPES, packed, frame)


@lru_cache(4)
def _without_content(frame: str, domain: Domain) -> tuple[bytes, bytes]:
    """``map/cells`` and ``map/observed`` serialised, without stamps and content."""
    maker = MessageMaker(TYPES, lambda values: array(values.dtype.char), frame)
    cloud = maker.cloud(np.empty(0, CELL_FIELDS), 0)
    grid = maker.observed(np.empty((domain.finest_count,) * 2, np.int8), domain, 0)
    return serialize_message(cloud), serialize_message(grid)


def map_messages(cells: CellMap, frame: str) -> tuple[bytes, bytes]:
    """Serialise ``map/cells`` and ``map/observed``. Their arrays are copied only once, into
    messages that rclpy serialised without them."""
    records, values = encode_cells(cells), encode_observed(cells.observed, cells.known)
    cloud, grid = map(bytearray, _without_content(frame, cells.domain))
    stamp = divmod(cells.stamp_ns, 1_000_000_000)
    for raw in (cloud, grid):
        struct.pack_into("<iI", raw, 4, *stamp)
    _, at = _read_string(cloud, 12)
    at += -at % 4
    struct.pack_into("<iI", grid, at, *stamp)  # when the map was loaded
    struct.pack_into("<I", cloud, at + 4, len(records))  # the width
    # In a cloud a row's length is before that of the data, of which one byte comes after them.
    struct.pack_into("<I", cloud, len(cloud) - 9, records.nbytes)
    return _filled(cloud, len(cloud) - 1, records), _filled(grid, len(grid), values)


def _filled(raw: bytearray, end: int, content: NDArray[Any]) -> bytes:
    """Insert content into a message whose empty array of bytes ends at ``end``."""
    length = struct.pack("<I", content.nbytes)
    return b"".join((raw[: end - len(length)], length, content.view(np.uint8).data, raw[end:]))


def time_message(stamp: int) -> Time:
    """Integer nanoseconds to a ROS time."""
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    return Time(sec=seconds, nanosec=nanoseconds)


def header_message(stamp: int, frame: str) -> Header:
    """Header with a stamp in nanoseconds."""
    return Header(stamp=time_message(stamp), frame_id=frame)


def deserialised(raw: bytes, kind: Any) -> Any:
    """Deserialise a message. Raises `MessageError`: not of this type (``damaged``)."""
    try:
        return deserialize_message(raw, kind)
    except RuntimeError:  # of the middleware
        msg = f"{len(raw)} bytes that came are no {kind.__name__}"
        raise MessageError("damaged", msg) from None


LITTLE_ENDIAN = b"\x00\x01"
"""What is serialised begins with it, as far as it is read here."""


def _read_string(raw: bytes, at: int) -> tuple[str, int]:
    """A string that begins at ``at`` or up to three bytes behind, and where it ends."""
    at += -at % 4
    (length,) = struct.unpack_from("<I", raw, at)
    return raw[at + 4 : at + 3 + length].decode(), at + 4 + length


def pose_message(raw: bytes, kind: Any) -> Any:
    """As of `deserialised` for ``PoseWithCovarianceStamped`` and ``Odometry``, the twist aside, in
    a fifth of the time: poses come at hundreds a second. Raises `MessageError`."""
    at, names = 12, []
    try:
        seconds, nanoseconds = struct.unpack_from("<iI", raw, 4)
        for _ in range(2 if kind is Odometry else 1):
            name, at = _read_string(raw, at)
            names.append(name)
        numbers = np.frombuffer(raw, "<f8", 7 + 36, at + (4 - at) % 8)
    except (struct.error, ValueError):
        return deserialised(raw, kind)
    if raw[:2] != LITTLE_ENDIAN:
        return deserialised(raw, kind)
    x, y, z, *turn = numbers[:7].tolist()
    pose = SimpleNamespace(position=SimpleNamespace(x=x, y=y, z=z))
    pose.orientation = SimpleNamespace(x=turn[0], y=turn[1], z=turn[2], w=turn[3])
    stamp = SimpleNamespace(sec=seconds, nanosec=nanoseconds)
    message = SimpleNamespace(header=SimpleNamespace(stamp=stamp, frame_id=names[0]))
    message.pose = SimpleNamespace(pose=pose, covariance=numbers[7:])
    if len(names) > 1:
        message.child_frame_id = names[1]
    return message


def cloud_message(raw: bytes) -> Any:
    """As of `deserialised` for ``PointCloud2``, in a quarter of the time: its data are those of
    ``raw``, not copied. Raises `MessageError`."""
    fields = []
    try:
        seconds, nanoseconds = struct.unpack_from("<iI", raw, 4)
        frame, at = _read_string(raw, 12)
        height, width, count = struct.unpack_from("<3I", raw, at + -at % 4)
        at += -at % 4 + 12
        for _ in range(count):
            name, at = _read_string(raw, at)
            offset, kind, number = struct.unpack_from("<IB3xI", raw, at + -at % 4)
            at += -at % 4 + 12
            of = {"name": name, "offset": offset, "datatype": kind, "count": number}
            fields.append(SimpleNamespace(**of))
        big, point_step, row_step, size = struct.unpack_from("<B3x3I", raw, at)
        data, dense = memoryview(raw)[at + 16 : at + 16 + size], raw[at + 16 + size]
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
    """Convert to what rclpy accepts without a check as an array."""
    result = array(values.dtype.char)
    result.frombytes(values.view(np.uint8).data)
    return result
