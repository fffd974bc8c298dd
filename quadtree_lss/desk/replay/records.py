# SPDX-License-Identifier: Apache-2.0
"""Recorded messages as bytes, and the order in which they are to be read."""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadtree_lss.desk.replay.types import GIMBAL_TYPE, POSE_TYPES, SCAN_TYPE
from quadtree_lss.desk.replay.unpack import MOST_BYTES, DamagedError, unpack

Times = NDArray[np.int64]

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
HOUR_NS = 3600 * 10**9
YEAR_NS = 365 * 24 * HOUR_NS
JITTER_NS = 10**8
LAST_NS = 2**63 - 1
"""Times of reception beyond are none."""


class RawMessage(NamedTuple):
    """A message as recorded: topic, time of reception, serialised bytes."""

    topic: str
    received_ns: int
    raw: bytes


class Extent(NamedTuple):
    """What a first look at a file finds: types and numbers by topic, first and last time."""

    types: dict[str, str]
    counts: dict[str, int]
    start_ns: int
    end_ns: int


def mended(times: ArrayLike) -> tuple[Times, int]:
    """Times of messages one after the other, and how many of them cannot be.

    A time is impossible if it lies more than an hour from its neighbours, which agree with each
    other; the first and the last if it lies a year away. It is taken to be its neighbour's.
    """
    out = np.minimum(np.asarray(times, dtype=np.uint64), LAST_NS).astype(np.int64)
    if len(out) < 3:
        return out, 0
    step = np.abs(np.diff(out.astype(np.float64)))
    over = np.abs(out[2:].astype(np.float64) - out[:-2])
    bad = np.zeros(len(out), dtype=np.bool_)
    bad[1:-1] = (step[:-1] > HOUR_NS) & (step[1:] > HOUR_NS) & (over < HOUR_NS)
    bad[0] = step[0] > YEAR_NS and step[1] < HOUR_NS
    bad[-1] = step[-1] > YEAR_NS and step[-2] < HOUR_NS
    for k in np.flatnonzero(bad):
        out[k] = out[k - 1] if k else out[1]
    return out, int(np.count_nonzero(bad))


def steps_back(times: ArrayLike) -> int:
    """How many are earlier than the one before, by more than messages overtake each other."""
    series = np.asarray(times, dtype=np.int64)
    return int(np.count_nonzero(np.diff(series) < -JITTER_NS))


def stamp_of(raw: bytes, msgtype: str, ros1: bool) -> int | None:
    """Stamp in the header of a serialised message, ns; None if it has none that we know."""
    if msgtype not in (SCAN_TYPE, *POSE_TYPES, GIMBAL_TYPE):
        return None
    try:
        if raw[:4] == ZSTD_MAGIC:
            raw = unpack("zstd", raw, MOST_BYTES)
        big = not ros1 and raw[1] == 0
        seconds, nanoseconds = struct.unpack_from(">II" if big else "<II", raw, 4)
    except (DamagedError, struct.error, IndexError):
        return None
    return int(seconds) * 10**9 + int(nanoseconds)
