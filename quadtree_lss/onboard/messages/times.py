# SPDX-License-Identifier: Apache-2.0
"""Decoding of point times in the formats of common lidar drivers (``msg_docs/inputs.md``).

Drivers use the same names with several units. A unit is accepted only if the times span a scan.
"""

from __future__ import annotations

import re
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Points
from quadtree_lss.onboard.messages.clouds import MessageError, column

#: Names of fields with times; the first one that differs from point to point is used.
FIELDS = (
    *("t", "time", "timestamp", "time_stamp", "time_offset", "offset_time", "time_offset_ns"),
    *("point_time_offset", "point_time", "relative_time", "stamps", "timestamps", "ts", "t_us"),
    *("time_us", "timestamp_ns", "timestamp_us", "time_ns", "t_ns"),
)
#: Names of other fields that are read as times if a cloud has only one of them.
TIME_NAME = re.compile(r"time|stamp|(^|_)(d?t|ts|[mun]?secs?|nanosecs?)($|_)", re.IGNORECASE)
#: NumPy type codes by `sensor_msgs/PointField` datatype of a time.
TYPES = {5: "i4", 6: "u4", 7: "f4", 8: "f8"}
#: Limit of plausible times from the stamp, ns.
MAX_OFFSET_NS = 1_000_000_000
#: Units of integers and of floats, ns, the most common first.
UNITS = {"i": (1.0, 1e3, 1e6), "u": (1.0, 1e3, 1e6), "f": (1e9, 1.0, 1e3, 1e6)}
#: Limits of a scan's duration, periods. Units differ by 1000, so that only one fits.
MIN_PERIODS, MAX_PERIODS = 0.05, 2.5
#: These limits at 20 Hz and 10 Hz, ns, for an unknown period.
DEFAULT_SPAN_NS = (2.5e6, 0.25e9)


class PointTimes(NamedTuple):
    """Point times. ``offsets``: (N,) ns from the stamp. ``span``: least and greatest offset, 0
    included."""

    offsets: NDArray[np.int32]
    span: tuple[int, int]


def offsets_from_cloud(
    msg: Any, stamp_ns: int, points: Points, period_ns: float | None = None
) -> PointTimes | None:
    """Decode the times of a cloud's points; None if it has none, or the same for all points.

    ``msg``: like ``sensor_msgs/PointCloud2``. ``stamp_ns``: of its header. ``points``: from
    `points_from_cloud`; only times of returns are checked. ``period_ns``: time from scan to scan,
    None if unknown. Raises `MessageError` with reason ``unknown``, ``type`` or ``layout`` of the
    field, or ``unreasonable`` if the times do not span a scan near the stamp in any unit.
    """
    fields = [f for name in FIELDS for f in msg.fields if f.name == name]
    if not fields:
        fields = [f for f in msg.fields if TIME_NAME.search(f.name)]
        if len(fields) > 1:
            names = "', '".join(f.name for f in fields)
            text = f"cloud fields '{names}' may hold times and are not known: they are ignored;"
            text += f" known names: {', '.join(FIELDS)}"
            raise MessageError("unknown", text)
    first_error: MessageError | None = None
    for field in fields:
        try:
            if (found := _offsets(msg, field, stamp_ns, points, period_ns)) is not None:
                return found
        except MessageError as error:
            first_error = first_error or error
    if first_error is not None:
        raise first_error
    return None


def _offsets(
    msg: Any, field: Any, stamp_ns: int, points: Points, period_ns: float | None
) -> PointTimes | None:
    """Decode the times in one field. Returns and raises as `offsets_from_cloud`."""
    kind = TYPES.get(int(field.datatype))
    if kind is None:
        text = f"cloud field '{field.name}' has datatype {field.datatype}, unsupported for times"
        raise MessageError("type", text)
    values = column(msg, field, kind).reshape(-1)
    returned = values[np.isfinite(points[..., 2]).reshape(-1)]
    if not len(returned):
        return None
    low, high = float(returned.min()), float(returned.max())
    coarse = kind == "f4" and max(abs(low), abs(high)) >= 2.0**24  # steps of 2 and more
    if low == high and not coarse:
        return None
    for wrapped, (scale, zero) in _interpretations(kind, field.name, stamp_ns):
        ends = [value * scale - zero for value in (low, high)]
        if wrapped:
            signed = returned.astype("=i4")
            ends = [float(signed.min()), float(signed.max())]
        if low < high and _spans_a_scan(ends, period_ns):
            with np.errstate(invalid="ignore", over="ignore"):
                exact = values.astype("=i4" if wrapped else "=f8") * scale - zero
                offsets = np.rint(exact).astype(np.int32)
            first, last = (round(end) for end in ends)
            return PointTimes(offsets, (min(first, 0), max(last, 0)))
    period = "" if period_ns is None else f" of {period_ns * 1e-9:.3g} s"
    text = (
        f"cloud field '{field.name}' holds times from {low:.9g} to {high:.9g}, which in no known"
        f" unit span a scan period{period} near the stamp; they are ignored"
    )
    raise MessageError("unreasonable", text)


def _interpretations(kind: str, name: str, stamp_ns: int) -> list[tuple[bool, tuple[float, float]]]:
    """List possible meanings of times, the most common first: whether unsigned ns are negative
    ones, the unit, ns, and the value that stands for the scan's stamp, ns."""
    zeros = (stamp_ns, 0) if name == "timestamp" and kind == "f8" else (0, stamp_ns)
    pairs = list(product(UNITS[kind[0]], zeros if kind[0] == "f" else (0,)))
    if name == "timestamp":  # common drivers send times since the epoch, in s or ns
        pairs.sort(key=lambda pair: pair[1] == 0)
    return [*((False, pair) for pair in pairs), *[(True, (1.0, 0.0))] * (kind == "u4")]


def _spans_a_scan(ends: list[float], period_ns: float | None) -> bool:
    """Return whether the first and last time, ns from the stamp, are those of one scan."""
    shortest, longest = DEFAULT_SPAN_NS
    if period_ns is not None:
        shortest, longest = MIN_PERIODS * period_ns, MAX_PERIODS * period_ns
    near = max(map(abs, ends)) <= min(longest, MAX_OFFSET_NS)
    return near and ends[1] - ends[0] >= shortest
