# SPDX-License-Identifier: Apache-2.0
"""Rejection of single poses that are inconsistent with their neighbours."""

from __future__ import annotations

from math import acos, hypot, sqrt
from operator import mul

from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.pose_buffer import JUMP_NS

#: Standard deviations between a pose and the extrapolation of the two poses before it ...
SIGMAS = 6.0
#: ... plus errors that the covariances do not contain, m and rad, ...
POSITION_TOLERANCE, ANGLE_TOLERANCE = 1.0, 0.3
#: ... plus motion of the vehicle in between, m/s^2 and rad/s.
MAX_ACCELERATION, MAX_TURN_RATE = 100.0, 6.0
#: The last of so many consecutive suspect poses is accepted.
MAX_SUSPECT_POSES = 5


class PoseGate:
    """Passes poses in the order of their stamps; holds a suspect one back until the next arrives.

    If the next pose is consistent with the suspect one, navigation has jumped and both pass. If it
    is consistent with the poses before, the suspect one is dropped and counted in ``dropped``.
    Poses farther apart than ``max_gap_ns`` are not compared.
    """

    def __init__(self, max_gap_ns: int) -> None:
        self.max_gap_ns = max_gap_ns
        self.dropped = 0
        self._last: list[Pose] = []
        self._suspect: list[Pose] = []

    def filter(self, pose: Pose) -> list[Pose]:
        """Take the next pose and return the poses that pass, at most two."""
        last = self._last
        gap_ns = pose.stamp_ns - last[-1].stamp_ns if last else 0
        if -JUMP_NS <= gap_ns <= 0 and last:  # late
            return [pose]
        if not 0 < gap_ns <= self.max_gap_ns:
            self._last = last = []
        if len(last) < 2 or is_consistent(last[0], last[1], pose):
            return self._accept([pose])
        suspect = self._suspect[-1:]
        agree = bool(suspect) and is_consistent(None, suspect[0], pose)
        if agree or len(self._suspect) + 1 >= MAX_SUSPECT_POSES:
            return self._accept([*suspect, pose])
        self._suspect.append(pose)
        return []

    def _accept(self, poses: list[Pose]) -> list[Pose]:
        self.dropped += len(self._suspect) + 1 - len(poses)
        self._suspect = []
        # Two poses with the same stamp give no velocity: keep the newer.
        newest = {pose.stamp_ns: pose for pose in (*self._last, *poses)}
        self._last = [newest[stamp_ns] for stamp_ns in sorted(newest)[-2:]]
        return poses


def is_consistent(before: Pose | None, last: Pose, pose: Pose) -> bool:
    """Return whether a pose is consistent with the last one, at the velocity from ``before``."""
    seconds = 1e-9 * (pose.stamp_ns - last.stamp_ns)
    ahead = 0.0 if before is None else seconds / (1e-9 * (last.stamp_ns - before.stamp_ns))
    # Hundreds of poses arrive per second: Python floats take a third of the time of arrays.
    position, rotation = _variances(pose)
    for other, weight in ((last, (1.0 + ahead) ** 2), (before, ahead**2)):
        if other is not None:
            position_part, rotation_part = _variances(other)
            position += weight * position_part
            rotation += weight * rotation_part
    new, old = pose.position.tolist(), last.position.tolist()
    earlier = old if before is None else before.position.tolist()
    step = [c - b - ahead * (b - a) for a, b, c in zip(earlier, old, new, strict=True)]
    max_step = POSITION_TOLERANCE + 0.5 * MAX_ACCELERATION * seconds**2 + SIGMAS * sqrt(position)
    max_angle = ANGLE_TOLERANCE + MAX_TURN_RATE * seconds + SIGMAS * sqrt(rotation)
    # tr(R_1 R_2^T) = 1 + 2 cos(angle) is the sum of the products of their entries.
    matrices = pose.rotation_map_lidar, last.rotation_map_lidar
    cosine = 0.5 * sum(map(mul, *(matrix.ravel().tolist() for matrix in matrices))) - 0.5
    angle = acos(min(max(cosine, -1.0), 1.0))
    return hypot(*step) <= max_step and angle <= max_angle


def _variances(pose: Pose) -> tuple[float, float]:
    """Return the sums of a pose's position variances, m^2, and rotation variances, rad^2."""
    x, y, z, roll, pitch, yaw = pose.covariance.diagonal().tolist()
    return x + y + z, roll + pitch + yaw
