# SPDX-License-Identifier: Apache-2.0
"""Decoding of point clouds into arrays of points in the lidar frame.

The functions accept any object with the attributes of ``sensor_msgs/PointCloud2``. Nodes (rclpy)
and replay (``rosbags``) therefore share this code and get the same points.
"""

from __future__ import annotations

import sys
from contextlib import suppress
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array, Bytes, Points
from quadtree_lss.onboard.core.sensing.lidar import points_from_ranges
from quadtree_lss.onboard.errors import QuadtreeLssError

CARTESIAN = ("x", "y", "z")
SPHERICAL = ("range", "azimuth", "elevation")
FLOAT_TYPES = {7: "f4", 8: "f8"}
"""Datatype constants of ``sensor_msgs/PointField`` that coordinates may have."""

MAX_POINTS = 1 << 22
"""Clouds with more points are rejected as damaged."""

MAX_DISTANCE = 1e6
"""Limit of plausible coordinates, m."""

MAX_ANGLE = 2.0 * np.pi + 1e-3
"""Limit of plausible angles, rad: one turn and rounding."""


class MessageError(QuadtreeLssError):
    """A message cannot be used; it is counted under the short key ``reason``."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


def points_from_cloud(msg: Any) -> Points:
    """Decode the points of a cloud, lidar axes, m; NaN means no return.

    The fields are x, y, z or range, azimuth, elevation (m, rad; Eq. 14: z boresight, x right, y
    down), each float32 or float64, at any offset, in either byte order, with any padding of points
    and rows. Infinite coordinates become NaN; coordinates beyond ``MAX_DISTANCE`` are clipped to
    it, so that the range gate counts them. ``msg``: like ``sensor_msgs/PointCloud2``.

    Returns (H, W, 3) float32 or float64 for an organised cloud (height > 1), otherwise (N, 3); a
    view of the message if its layout allows. Raises `MessageError` with reason ``size``,
    ``fields``, ``field_type``, ``layout``, ``too_large``, ``units`` or ``absurd``.
    """
    height, width = int(msg.height), int(msg.width)
    data = bytes_of(msg.data)
    if height * width == 0:
        if data.size:
            text = f"cloud of {width} x {height} points carries {data.size} bytes"
            raise MessageError("size", text)
        return np.empty((0, 3))
    if height * width > MAX_POINTS:
        text = f"cloud claims {width} x {height} points; {MAX_POINTS} is the most"
        raise MessageError("too_large", text)
    names, fields = _coordinate_fields(msg.fields)
    _check_layout(msg, fields, data.size)
    kinds = [FLOAT_TYPES[int(field.datatype)] for field in fields]
    view = _view(msg, fields, kinds, data) if names is CARTESIAN else None
    if view is not None and not (np.abs(view) > MAX_DISTANCE).any():
        return view if height > 1 else view[0]
    first, second, third = (column(msg, *pair) for pair in zip(fields, kinds, strict=True))
    with np.errstate(invalid="ignore", over="ignore"):
        if names is CARTESIAN:
            points = np.empty((height, width, 3), np.result_type(first, second, third))
            points[..., 0], points[..., 1], points[..., 2] = first, second, third
        else:
            points = _from_spherical(*(np.asarray(c, "=f8") for c in (first, second, third)))
    _limit(points)
    return points if height > 1 else points[0]


def column(msg: Any, field: Any, kind: str) -> NDArray[Any]:
    """View one field of a cloud that `points_from_cloud` has accepted, (height, width).

    ``kind``: NumPy type code without byte order. Raises `MessageError` with reason ``layout`` if
    the field lies outside a point or has several values.
    """
    data = bytes_of(msg.data)
    shape, strides = (msg.height, msg.width), (_row_step(msg, data.size), msg.point_step)
    order, (start, _) = ">" if msg.is_bigendian else "<", _span(msg, field, kind)
    return np.ndarray(shape, order + kind, data, start, strides)


def layout_note(msg: Any) -> str:
    """Describe wrong sizes in a cloud that `points_from_cloud` has accepted; empty without any."""
    size = bytes_of(msg.data).size
    row_step, packed = int(msg.row_step), int(msg.width) * int(msg.point_step)
    misread = row_step < packed or int(msg.height) > 1
    wrong = [f"row_step {row_step}"] * (misread and row_step != packed == _row_step(msg, size))
    fields = (field for field in msg.fields if field.name in CARTESIAN + SPHERICAL)
    wrong += [f"count {field.count} of '{field.name}'" for field in fields if field.count != 1]
    if size > int(msg.height) * max(packed, row_step):
        wrong.append(f"{size} bytes of data")
    if not wrong:
        return ""
    shape = f"{msg.width} x {msg.height} points of {msg.point_step} bytes"
    return (
        f"cloud of {shape} has {', '.join(wrong)}; read with rows of {packed} bytes and single"
        " values: correct the driver"
    )


def _row_step(msg: Any, size: int) -> int:
    """Return the bytes from row to row.

    Data of exactly height * width * point_step bytes has no padding. ``row_step`` is then ignored,
    because some drivers set it to 0, the number of points or the whole size.
    """
    packed = int(msg.width) * int(msg.point_step)
    return packed if size == int(msg.height) * packed else int(msg.row_step)


def _span(msg: Any, field: Any, kind: str) -> tuple[int, int]:
    """Return the first byte of a field in each point and the one after its last.

    A count of 0 or of all points is read as 1, because some drivers send these. Raises
    `MessageError`.
    """
    start, end = int(field.offset), int(field.offset) + int(kind[1])
    single = int(field.count) in (0, 1, int(msg.height) * int(msg.width))
    if not single or start < 0 or end > msg.point_step:
        text = (
            f"cloud field '{field.name}', {field.count} at bytes {start}..{end}, is not one value"
            f" within a point of {msg.point_step} bytes"
        )
        raise MessageError("layout", text)
    return start, end


def stamp_ns(header: Any) -> int:
    """Return the stamp of a ``std_msgs/Header``, ns. Raises `MessageError` with reason ``stamp``
    if its nanoseconds exceed a second."""
    seconds, nanoseconds = int(header.stamp.sec), int(header.stamp.nanosec)
    if not 0 <= nanoseconds < 1_000_000_000:
        text = f"stamp {seconds} s + {nanoseconds} ns: the nanoseconds exceed a second"
        raise MessageError("stamp", text)
    return seconds * 1_000_000_000 + nanoseconds


def bytes_of(data: Any) -> Bytes:
    """View data as bytes; copy them only if the type has no buffer."""
    with suppress(TypeError, ValueError, BufferError):
        return np.frombuffer(data, dtype=np.uint8)
    try:
        return np.frombuffer(bytes(data), dtype=np.uint8)
    except (TypeError, ValueError):
        text = f"cloud data of type {type(data).__name__} are not bytes"
        raise MessageError("size", text) from None


def _view(msg: Any, fields: list[Any], kinds: list[str], data: Bytes) -> Points | None:
    """View the coordinates as (height, width, 3); None if their layout does not allow it."""
    kind, size, start = kinds[0], int(kinds[0][1]), int(fields[0].offset)
    address = data.__array_interface__["data"][0] + start
    row_step = _row_step(msg, data.size)
    aligned = not any(n % size for n in (address, msg.point_step, row_step))
    adjacent = [int(field.offset) for field in fields] == [start, start + size, start + 2 * size]
    native = kinds == [kind] * 3 and bool(msg.is_bigendian) == (sys.byteorder == "big")
    if not (aligned and adjacent and native):
        return None
    shape, strides = (msg.height, msg.width, 3), (row_step, msg.point_step, size)
    return np.ndarray(shape, kind, data, start, strides)


def _check_layout(msg: Any, fields: list[Any], size: int) -> None:
    """Check the coordinate fields against ``size`` bytes of data. Raises `MessageError`."""
    point_step, row_step = int(msg.point_step), _row_step(msg, size)
    height, width = int(msg.height), int(msg.width)
    spans = []
    for field in fields:
        kind = FLOAT_TYPES.get(int(field.datatype))
        if kind is None:
            text = (
                f"cloud field '{field.name}' has datatype {field.datatype};"
                " float32 (7) or float64 (8) is needed"
            )
            raise MessageError("field_type", text)
        spans.append(_span(msg, field, kind))
    if any(a[1] > b[0] for a, b in pairwise(sorted(spans))):
        text = f"cloud fields {', '.join(field.name for field in fields)} overlap"
        raise MessageError("layout", text)
    if row_step < width * point_step:
        text = f"cloud row_step {row_step} is less than {width} points of {point_step} bytes"
        raise MessageError("size", text)
    # The last row may lack its padding. A buffer may be larger than its cloud if that is one row.
    min_size, max_size = (height - 1) * row_step + width * point_step, height * row_step
    may_be_larger = height == 1 and row_step == width * point_step
    if size < min_size or (size > max_size and not may_be_larger):
        text = f"cloud of {width} x {height} points needs {max_size} bytes, has {size}"
        raise MessageError("size", text)


def _coordinate_fields(fields: Any) -> tuple[tuple[str, ...], list[Any]]:
    found: dict[str, Any] = {}
    for field in fields:
        if field.name in found and field.name in CARTESIAN + SPHERICAL:
            text = f"cloud has two fields '{field.name}'"
            raise MessageError("fields", text)
        found[field.name] = field
    for names in (CARTESIAN, SPHERICAL):
        if all(name in found for name in names):
            return names, [found[name] for name in names]
    available = ", ".join(map(str, found)) or "none"
    text = f"cloud needs fields x, y, z or range, azimuth, elevation; it has {available}"
    raise MessageError("fields", text)


def _from_spherical(ranges: Array, azimuth: Array, elevation: Array) -> Array:
    too_large = (np.abs(azimuth) > MAX_ANGLE) | (np.abs(elevation) > MAX_ANGLE)
    invalid = too_large | (ranges < 0.0)
    if invalid.any():
        if 2 * np.count_nonzero(too_large) > np.count_nonzero(np.isfinite(azimuth)):
            text = "cloud azimuth and elevation exceed a turn: degrees where radians are needed?"
            raise MessageError("units", text)
        ranges = np.where(invalid, np.nan, ranges)
    return points_from_ranges(ranges, azimuth, elevation)


def _limit(points: Points) -> None:
    """Set infinite coordinates to NaN and clip implausible ones, in place."""
    far = np.abs(points) > MAX_DISTANCE
    if not far.any():
        return
    points[np.isinf(points)] = np.nan
    far &= ~np.isnan(points)
    count, usable = np.count_nonzero(far.any(axis=-1)), np.count_nonzero(~np.isnan(points[..., 2]))
    if 2 * count > usable:
        text = (
            f"cloud has {count} of {usable} points beyond {MAX_DISTANCE:.0e} m:"
            " wrong byte order, unit or offsets?"
        )
        raise MessageError("absurd", text)
    np.clip(points, -MAX_DISTANCE, MAX_DISTANCE, out=points)
