# SPDX-License-Identifier: Apache-2.0
"""A pose that contradicts its neighbours, and its own covariance, is no pose."""

from __future__ import annotations

from math import acos, hypot, sqrt
from operator import mul

from quadtree_lss.onboard.core.sensing.lidar import Pose

#: Deviations that a pose may lie from where the two before it lead.
SIGMAS = 6.0
#: What no covariance tells, m and rad, ...
POSITION_TOLERANCE, ANGLE_TOLERANCE = 1.0, 0.3
#: ... and how a vehicle may move in between, m/s^2 and rad/s.
MAX_ACCELERATION, MAX_TURN_RATE = 100.0, 6.0
#: A step back in time by at most this is a late pose, which is not judged, ns.
JUMP_NS = 10**9
#: So many suspect poses in a row are believed, whatever they are.
MAX_SUSPECT_POSES = 5


class PoseGate:
    """Lets poses pass in the order of their stamps; one that leaps waits for the next.

    If the next pose is where the leap led, both are believed: navigation has jumped. If it is where
    the poses before lead, the one that leapt is ``dropped``, and counted. Poses farther apart than
    ``max_gap_ns`` say nothing of each other.
    """

    def __init__(self, max_gap_ns: int) -> None:
        self.max_gap_ns = max_gap_ns
        self.dropped = 0
        self._last: list[Pose] = []
        self._suspect: list[Pose] = []

    def filter(self, pose: Pose) -> list[Pose]:
        """The poses, none to two, that may be used now that one has come."""
        last = self._last
        gap_ns = pose.stamp_ns - last[-1].stamp_ns if last else 0
        if -JUMP_NS <= gap_ns <= 0 and last:
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
        # Of the same stamp, two say nothing of the way from one to the other.
        newest = {pose.stamp_ns: pose for pose in (*self._last, *poses)}
        self._last = [newest[stamp_ns] for stamp_ns in sorted(newest)[-2:]]
        return poses


def is_consistent(before: Pose | None, last: Pose, pose: Pose) -> bool:
    """Whether a pose can follow on another, at the velocity from the one before that."""
    seconds = 1e-9 * (pose.stamp_ns - last.stamp_ns)
    ahead = 0.0 if before is None else seconds / (1e-9 * (last.stamp_ns - before.stamp_ns))
    # Poses come one by one, at hundreds a second: plain numbers take a third of the time.
    place, turn = _variances(pose)
    last_place, last_turn = _variances(last)
    place, turn = place + (1.0 + ahead) ** 2 * last_place, turn + (1.0 + ahead) ** 2 * last_turn
    now, then = pose.position.tolist(), last.position.tolist()
    earlier = then
    if before is not None:
        earlier = before.position.tolist()
        first_place, first_turn = _variances(before)
        place, turn = place + ahead**2 * first_place, turn + ahead**2 * first_turn
    step = [c - b - ahead * (b - a) for a, b, c in zip(earlier, then, now, strict=True)]
    moved = POSITION_TOLERANCE + 0.5 * MAX_ACCELERATION * seconds**2 + SIGMAS * sqrt(place)
    turned = ANGLE_TOLERANCE + MAX_TURN_RATE * seconds + SIGMAS * sqrt(turn)
    # tr(R_1 R_2^T) = 1 + 2 cos(angle) is the sum of the products of their entries.
    matrices = pose.rotation_map_lidar, last.rotation_map_lidar
    cosine = 0.5 * sum(map(mul, *(of.ravel().tolist() for of in matrices))) - 0.5
    angle = acos(min(max(cosine, -1.0), 1.0))
    return hypot(*step) <= moved and angle <= turned


def _variances(pose: Pose) -> tuple[float, float]:
    """Of a pose's place, m^2, and turn, rad^2, of all three axes."""
    x, y, z, roll, pitch, yaw = pose.covariance.diagonal().tolist()
    return x + y + z, roll + pitch + yaw
