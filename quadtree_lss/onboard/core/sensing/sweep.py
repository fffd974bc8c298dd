# SPDX-License-Identifier: Apache-2.0
"""Motion of a scanning lidar during a scan: each point gets the pose at its own time.

Between poses, position and rotation are interpolated as in `pose_buffer.interpolate`. The result is
a table of rotations so close to each other that the kernel can interpolate the matrices linearly.
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

#: Greatest angle between consecutive rotations of the table, rad: the error of linear
#: interpolation is its square over 8.
MAX_ANGLE = 2e-3
#: ``offsets`` and ``times`` of a scan whose points have no times of their own.
NO_OFFSETS, STAMP_ONLY = np.empty(0, dtype=np.int32), np.zeros(1)


@dataclass(frozen=True)
class Sweep:
    """Times of the points of a scan and motion of the lidar.

    Attributes:
        offsets: (N,) int32 time of each point, in the order of the cloud, ns from the stamp.
        times: (K,) of the table, ascending, ns from the stamp.
        motion: (K, 12) rotation_map_lidar row by row, and the displacement since the stamp in map
            axes, m.
    """

    offsets: Ints
    times: Array
    motion: Array


def interpolate_sweep(offsets: Ints, at_stamp: Pose, poses: Sequence[Pose]) -> Sweep:
    """Interpolate the motion of the lidar during a scan.

    Args:
        offsets: (N,) time of each point, ns from the stamp.
        at_stamp: Pose at the scan's stamp.
        poses: Two or more, the first and last of which bound the points' times.
    """
    stamp = at_stamp.stamp_ns
    times = np.array([pose.stamp_ns - stamp for pose in poses], dtype=np.float64)
    displacements = np.array([pose.position for pose in poses]) - at_stamp.position
    rotations = np.array([pose.rotation_map_lidar for pose in poses])
    rotation_vectors = log(rotations[:-1].transpose(0, 2, 1) @ rotations[1:])
    angles = np.linalg.norm(rotation_vectors, axis=1)
    parts = np.maximum(np.ceil(angles / MAX_ANGLE), 1.0).astype(np.intp)
    segment = np.repeat(np.arange(len(parts)), parts)
    share = (np.arange(len(segment)) - (np.cumsum(parts) - parts)[segment]) / parts[segment]
    motion = np.empty((len(segment) + 1, 12))
    turned = rotations[segment] @ exp(share[:, None] * rotation_vectors[segment])
    motion[:-1, :9] = turned.reshape(-1, 9)
    step = displacements[segment + 1] - displacements[segment]
    motion[:-1, 9:] = displacements[segment] + share[:, None] * step
    motion[-1, :9], motion[-1, 9:] = rotations[-1].ravel(), displacements[-1]
    between = times[segment] + share * (times[segment + 1] - times[segment])
    return Sweep(offsets, np.append(between, times[-1]), motion)


def poses_during(source: PoseSource, first_ns: int, last_ns: int) -> list[Pose]:
    """Return the poses at two stamps and those between; ``source`` must cover all of them."""
    stamps = [first_ns, *source.stamps_between(first_ns, last_ns), last_ns]
    return [pose for pose in map(source.pose_at, stamps) if pose is not None]


def find_uncovered_stamp(source: PoseSource, first_ns: int, last_ns: int) -> int | None:
    """Return a stamp in first_ns … last_ns without a pose, None if all have one."""
    if first_ns == last_ns:
        return None if source.covers(first_ns) else first_ns
    stamps = [first_ns, *source.stamps_between(first_ns, last_ns), last_ns]
    gaps = [(before + after) // 2 for before, after in pairwise(stamps)]
    missing = (s for s in (first_ns, last_ns, *gaps) if not source.covers(s))
    return next(missing, None)
