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

Other drivers use these names with other units. A unit is only believed if the times span a scan.
"""

from __future__ import annotations

import re
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Points
from quadtree_lss.onboard.messages.clouds import MessageError, column

#: Fields that hold the times; the first that differs from point to point does.
FIELDS = (
    *("t", "time", "timestamp", "time_stamp", "time_offset", "offset_time", "time_offset_ns"),
    *("point_time_offset", "point_time", "relative_time", "stamps", "timestamps", "ts", "t_us"),
    *("time_us", "timestamp_ns", "timestamp_us", "time_ns", "t_ns"),
)
#: Names of fields that hold times as well if there is only one of them.
LIKE_TIME = re.compile(r"time|stamp|(^|_)(d?t|ts|[mun]?secs?|nanosecs?)($|_)", re.IGNORECASE)
#: `sensor_msgs/PointField` datatypes of a time.
TYPES = {5: "i4", 6: "u4", 7: "f4", 8: "f8"}
#: Times farther from the stamp than this are taken for wrong, ns.
MAX_OFFSET_NS = 1_000_000_000
#: Units of integers and of floats, ns, the usual first.
UNITS = {"i": (1.0, 1e3, 1e6), "u": (1.0, 1e3, 1e6), "f": (1e9, 1.0, 1e3, 1e6)}
#: A scan lasts from so little to so many periods: units, a thousandfold apart, are told by it.
LEAST_PERIODS, MOST_PERIODS = 0.05, 2.5
#: Where the period is not known yet, a scan lasts as long as at 20 Hz to 10 Hz by those limits, ns.
USUAL_SPAN_NS = (2.5e6, 0.25e9)


class PointTimes(NamedTuple):
    """``offsets``: (N,) ns from the stamp. ``span``: the first and last, the stamp among them.
    ``note``: how the field was read if that is not as its drivers document it, else empty."""

    offsets: NDArray[np.int32]
    span: tuple[int, int]
    note: str = ""


def offsets_from_cloud(
    msg: Any, stamp_ns: int, points: Points, period_ns: float | None = None
) -> PointTimes | None:
    """Times of a cloud's points; None if it has none, or the same for all, which says no more than
    its stamp. ``msg``: like ``sensor_msgs/PointCloud2``. ``stamp_ns``: of its header. ``points``:
    of `points_from_cloud`; times of points that are no returns do not matter. ``period_ns``: from
    scan to scan, None if that is not known yet. Raises `MessageError`: ``type`` or ``layout`` of
    the field; ``unreasonable`` if the times do not span a scan near the stamp in any unit."""
    fields = [f for name in FIELDS for f in msg.fields if f.name == name]
    if not fields:
        fields = [f for f in msg.fields if LIKE_TIME.search(f.name)]
        if len(fields) > 1:
            names = "', '".join(f.name for f in fields)
            text = f"cloud fields '{names}' may hold times and are not known: the scan is taken as"
            text += f" of one time; known are {', '.join(FIELDS)}"
            raise MessageError("unknown", text)
    wrong: MessageError | None = None
    for field in fields:
        try:
            if (found := _offsets(msg, field, stamp_ns, points, period_ns)) is not None:
                return found
        except MessageError as error:
            wrong = wrong or error
    if wrong is not None:
        raise wrong
    return None


def _offsets(
    msg: Any, field: Any, stamp_ns: int, points: Points, period_ns: float | None
) -> PointTimes | None:
    """Times in one field; None if they are the same for all. Raises as `offsets_from_cloud`."""
    kind = TYPES.get(int(field.datatype))
    if kind is None:
        text = f"cloud field '{field.name}' has datatype {field.datatype}, which is no time's"
        raise MessageError("type", text)
    values = column(msg, field, kind).reshape(-1)
    returned = values[np.isfinite(points[..., 2]).reshape(-1)]
    if not len(returned):
        return None
    low, high = float(returned.min()), float(returned.max())
    coarse = kind == "f4" and max(abs(low), abs(high)) >= 2.0**24  # steps of 2 and more
    if low == high and not coarse:
        return None
    for wrapped, (scale, zero) in _ways(kind, field.name, stamp_ns):
        ends = [value * scale - zero for value in (low, high)]
        if wrapped:
            signed = returned.astype("=i4")
            ends = [float(signed.min()), float(signed.max())]
        if low < high and _spans_a_scan(ends, period_ns):
            with np.errstate(invalid="ignore", over="ignore"):
                exact = values.astype("=i4" if wrapped else "=f8") * scale - zero
                offsets = np.rint(exact).astype(np.int32)
            first, last = (round(end) for end in ends)
            return PointTimes(offsets, (min(first, 0), max(last, 0)), _note(field, kind, scale))
    period = "" if period_ns is None else f" of {period_ns * 1e-9:.3g} s"
    text = (
        f"cloud field '{field.name}' holds times from {low:.9g} to {high:.9g}, which in no known"
        f" unit span a scan period{period} near the stamp: the scan is taken as of one time"
    )
    raise MessageError("unreasonable", text)


def _ways(kind: str, name: str, stamp_ns: int) -> list[tuple[bool, tuple[float, float]]]:
    """How times may be meant, the usual way first: whether unsigned ns went below zero; unit, ns;
    what they count from, ns."""
    zeros = (stamp_ns, 0) if name == "timestamp" and kind == "f8" else (0, stamp_ns)
    ways = list(product(UNITS[kind[0]], zeros if kind[0] == "f" else (0,)))
    if name == "timestamp":  # by its usual drivers since the epoch, whether in s or ns
        ways.sort(key=lambda way: way[1] == 0)
    return [*((False, way) for way in ways), *[(True, (1.0, 0.0))] * (kind == "u4")]


def _spans_a_scan(ends: list[float], period_ns: float | None) -> bool:
    """Whether times between these, ns from the stamp, are those of one scan."""
    least, most = USUAL_SPAN_NS
    if period_ns is not None:
        least, most = LEAST_PERIODS * period_ns, MOST_PERIODS * period_ns
    near = max(map(abs, ends)) <= min(most, MAX_OFFSET_NS)
    return near and ends[1] - ends[0] >= least


def _note(field: Any, kind: str, scale: float) -> str:
    documented = scale == 1.0 if kind in ("i4", "u4") else scale in (1.0, 1e9)
    if documented or field.name.endswith("_us"):
        return ""
    unit = {1e3: "microseconds", 1e6: "milliseconds"}[scale]
    return f"cloud field '{field.name}' is read in {unit}: in these it spans a scan period"
