# SPDX-License-Identifier: Apache-2.0
"""How a scanning lidar moved while it took a scan: each point has the pose at its own time.

Between poses the position moves linearly and the rotation at constant rate, as everywhere. What
the loop over points needs of that is a table of rotations so close to each other that those
between them are a blend of the matrices on either side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from quadtree_lss.onboard.arrays import Array, Ints
from quadtree_lss.onboard.core.geometry.rotations import exp, log
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import PoseSource

#: Angle between two rotations of the table, rad: a blend errs by its square over eight.
MAX_ANGLE = 2e-3
#: No point has a time of its own, and the table that of the stamp.
NO_OFFSETS, STAMP_ONLY = np.empty(0, dtype=np.int32), np.zeros(1)


@dataclass(frozen=True)
class Sweep:
    """Times of a scan's points and the lidar's motion.

    Attributes:
        offsets: (N,) int32 time of each point, in the order of the cloud, ns from the stamp.
        times: (K,) of the table, ascending, ns from the stamp.
        motion: (K, 12) rotation_map_lidar row by row, and the lidar's way since the stamp in map
            axes, m.
    """

    offsets: Ints
    times: Array
    motion: Array


def interpolate_sweep(offsets: Ints, at_stamp: Pose, poses: Sequence[Pose]) -> Sweep:
    """Motion through ``poses``, the first and last of which bound the points' times. ``offsets``:
    (N,) ns from the stamp of ``at_stamp``."""
    stamp = at_stamp.stamp_ns
    times = np.array([pose.stamp_ns - stamp for pose in poses], dtype=np.float64)
    ways = np.array([pose.position for pose in poses]) - at_stamp.position
    rotations = np.array([pose.rotation_map_lidar for pose in poses])
    turns = log(rotations[:-1].transpose(0, 2, 1) @ rotations[1:])
    parts = np.maximum(np.ceil(np.linalg.norm(turns, axis=1) / MAX_ANGLE), 1.0).astype(np.intp)
    of = np.repeat(np.arange(len(parts)), parts)
    share = (np.arange(len(of)) - (np.cumsum(parts) - parts)[of]) / parts[of]
    motion = np.empty((len(of) + 1, 12))
    turned = rotations[of] @ exp(share[:, None] * turns[of])
    motion[:-1, :9] = turned.reshape(-1, 9)
    motion[:-1, 9:] = ways[of] + share[:, None] * (ways[of + 1] - ways[of])
    motion[-1, :9], motion[-1, 9:] = rotations[-1].ravel(), ways[-1]
    between = times[of] + share * (times[of + 1] - times[of])
    return Sweep(offsets, np.append(between, times[-1]), motion)


def poses_during(source: PoseSource, first_ns: int, last_ns: int) -> list[Pose]:
    """Poses at both ends and those that are known between; all must be covered."""
    stamps = [first_ns, *source.stamps_between(first_ns, last_ns), last_ns]
    return [pose for pose in map(source.pose_at, stamps) if pose is not None]


def find_uncovered_stamp(source: PoseSource, first_ns: int, last_ns: int) -> int | None:
    """A stamp in first_ns … last_ns for which there is no pose, None if there is none such."""
    if first_ns == last_ns:
        return None if source.covers(first_ns) else first_ns
    stamps = [first_ns, *source.stamps_between(first_ns, last_ns), last_ns]
    gaps = [(before + after) // 2 for before, after in pairwise(stamps)]
    lacking = (s for s in (first_ns, last_ns, *gaps) if not source.covers(s))
    return next(lacking, None)
