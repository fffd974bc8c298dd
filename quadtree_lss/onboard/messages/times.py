# SPDX-License-Identifier: Apache-2.0
"""Times of a cloud's points, as the drivers of scanning lidars send them.

| driver | field | type | meaning |
| --- | --- | --- | --- |
| Ouster | `t` | uint32 | ns after the stamp |
| Velodyne | `time` | float32 | s from the stamp, negative if that is of the last packet |
| Hesai | `timestamp` | float64 | s since the epoch |
| Nebula | `time_stamp` | uint32 | ns after the stamp |
| Livox | `timestamp` | float64 | ns since the epoch |
| Livox | `offset_time` | uint32 | ns after the stamp |
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Points
from quadtree_lss.onboard.messages.clouds import MessageError, column

#: Fields that may hold the times; the first that is there does.
FIELDS = ("t", "time", "timestamp", "time_stamp", "time_offset", "offset_time")
#: `sensor_msgs/PointField` datatypes of a time: integers count nanoseconds.
TYPES = {5: "i4", 6: "u4", 7: "f4", 8: "f8"}
#: Times farther from the stamp than this are taken for wrong, ns.
MAX_OFFSET_NS = 1_000_000_000


def offsets_from_cloud(
    msg: Any, stamp_ns: int, points: Points
) -> tuple[NDArray[np.int32], tuple[int, int]] | None:
    """Times of a cloud's points, and the first and last of them with the stamp among them. ``msg``:
    like ``sensor_msgs/PointCloud2``. ``stamp_ns``: of its header. ``points``: of
    `points_from_cloud`; times of points that are no returns do not matter. Raises `MessageError`:
    ``type`` or ``layout`` of the field; ``unreasonable`` if times are not finite or too far from
    the stamp.

    Returns:
        (N,) ns from the stamp and their span; None if the cloud has no times, or the same for all,
        which says no more than its stamp.
    """
    field = next((f for name in FIELDS for f in msg.fields if f.name == name), None)
    if field is None:
        return None
    kind = TYPES.get(int(field.datatype))
    if kind is None:
        text = f"cloud field '{field.name}' has datatype {field.datatype}, which is no time's"
        raise MessageError("type", text)
    values = column(msg, field, kind).reshape(-1)
    returned = values[np.isfinite(points[..., 2]).reshape(-1)]
    if not len(returned) or returned.min() == returned.max():
        return None
    low, high = float(returned.min()), float(returned.max())
    ways = [(1.0, 0)] if kind in ("i4", "u4") else [(1e9, 0), (1e9, stamp_ns), (1.0, stamp_ns)]
    if field.name == "timestamp":
        ways = ways[1:] + ways[:1]  # as a rule since the epoch
    for scale, zero in ways:
        ends = [value * scale - zero for value in (low, high)]
        if max(map(abs, ends)) <= MAX_OFFSET_NS:
            with np.errstate(invalid="ignore", over="ignore"):
                exact = values.astype(np.float64) * scale - zero
                offsets = np.rint(exact).astype(np.int32)
            first, last = (round(end) for end in ends)
            return offsets, (min(first, 0), max(last, 0))
    text = (
        f"cloud field '{field.name}' holds times from {low:g} to {high:g}, which are not within"
        f" {MAX_OFFSET_NS / 1e9:g} s of the stamp in any known unit: the scan is taken as of one"
        " time"
    )
    raise MessageError("unreasonable", text)
