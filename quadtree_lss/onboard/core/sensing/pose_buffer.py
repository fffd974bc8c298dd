# SPDX-License-Identifier: Apache-2.0
"""A buffer of stamped poses with interpolation."""

from __future__ import annotations

import bisect

from quadtree_lss.onboard.core.geometry.rotations import slerp
from quadtree_lss.onboard.core.sensing.lidar import Pose

SECOND_NS = 1_000_000_000
MAX_POSES = 100_000
#: Stamps that go back by more than this mean that time jumped back (a looping bag), ns.
JUMP_NS = SECOND_NS


def seconds(stamp_ns: int) -> str:
    """Format a stamp in seconds, to the microsecond."""
    return f"{stamp_ns // SECOND_NS}.{stamp_ns % SECOND_NS // 1000:06d} s"


def interpolate(before: Pose, after: Pose, stamp_ns: int) -> Pose:
    """Interpolate position and covariance linearly, the rotation at constant rate."""
    share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    return Pose(
        stamp_ns,
        (1.0 - share) * before.position + share * after.position,
        slerp(before.rotation_map_lidar, after.rotation_map_lidar, share),
        (1.0 - share) * before.covariance + share * after.covariance,
    )


class PoseBuffer:
    """The poses of the last ``span_ns``, in the order of their stamps.

    Poses farther apart than ``max_gap_ns`` are not interpolated. A pose that is older than the
    newest by at most `JUMP_NS` is a late message and is inserted. An older one means that time
    jumped back: all other poses are deleted, and ``jumps`` is incremented.
    ``what``: name of a pose in messages.
    """

    def __init__(self, span_ns: int, max_gap_ns: int, what: str = "pose") -> None:
        self.span_ns = span_ns
        self.max_gap_ns = max_gap_ns
        self.what = what
        self.jumps = 0
        self._stamps: list[int] = []
        self._poses: list[Pose] = []

    def __len__(self) -> int:
        return len(self._poses)

    @property
    def range_ns(self) -> tuple[int, int] | None:
        """Oldest and newest stamp held, None when empty."""
        return (self._stamps[0], self._stamps[-1]) if self._stamps else None

    def clear(self) -> None:
        """Delete all poses."""
        self._stamps.clear()
        self._poses.clear()

    def add(self, pose: Pose) -> str | None:
        """Add a pose. Return None, or a reason.

        ``duplicate``: ignored, because the buffer holds a pose with this stamp. ``too_old``:
        ignored, because it is older than all others. ``time_jump``: added, all others deleted.
        """
        stamp = pose.stamp_ns
        if not self._stamps or stamp > self._stamps[-1]:
            self._stamps.append(stamp)
            self._poses.append(pose)
            self._trim()
            return None
        if stamp < self._stamps[-1] - JUMP_NS:
            self.clear()
            self.jumps += 1
            self.add(pose)
            return "time_jump"
        index = bisect.bisect_left(self._stamps, stamp)
        if self._stamps[index] == stamp:
            return "duplicate"
        if index == 0:
            return "too_old"
        self._stamps.insert(index, stamp)
        self._poses.insert(index, pose)
        return None

    def pose_at(self, stamp_ns: int) -> Pose | None:
        """Return the pose at a stamp, interpolated if necessary, None if it is not covered."""
        around = self._bracket(stamp_ns)
        if around is None:
            return None
        before, after = around
        return after if after.stamp_ns == stamp_ns else interpolate(before, after, stamp_ns)

    def covers(self, stamp_ns: int) -> bool:
        """Return whether `pose_at` returns a pose."""
        return self._bracket(stamp_ns) is not None

    def stamps_between(self, first_ns: int, last_ns: int) -> list[int]:
        """Return the stamps of the poses between two stamps, both excluded."""
        start = bisect.bisect_right(self._stamps, first_ns)
        return self._stamps[start : bisect.bisect_left(self._stamps, last_ns)]

    def timeout_reason(self, stamp_ns: int) -> str:
        """Return the reason to count for a scan whose wait for a pose timed out, ``no_pose``."""
        return "no_pose"

    def drop_reason(self, stamp_ns: int) -> str | None:
        """Return ``before_poses`` or ``pose_gap`` if no later pose can cover a stamp, else None."""
        if not self._stamps or self._stamps[-1] < stamp_ns or self.covers(stamp_ns):
            return None
        return "before_poses" if stamp_ns < self._stamps[0] else "pose_gap"

    def explain(self, stamp_ns: int, topic: str) -> str:
        """Return a clause for a log line: the stamps held on ``topic`` and the likely cause."""
        if not self._stamps:
            return (
                f"no {self.what} has arrived on '{topic}': is anything publishing there, with"
                " matching QoS and frame?"
            )
        oldest, newest = self._stamps[0], self._stamps[-1]
        what = f"{self.what}s"
        held = f"'{topic}' holds {seconds(oldest)} .. {seconds(newest)} ({len(self)} {what})"
        ahead, behind = (stamp_ns - newest) / SECOND_NS, (oldest - stamp_ns) / SECOND_NS
        if max(ahead, behind) > 2.0 * max(self.span_ns / SECOND_NS, 10.0):
            return f"{held}: the stamps come from different clocks"
        if ahead > 0.0:
            return (
                f"{held}: {what} are {ahead:.3f} s behind, late (pose.max_wait) or no longer sent"
            )
        if behind > 0.0:
            kept = f"{self.span_ns / SECOND_NS:g} s are kept"
            return f"{held}: the scan is {behind:.3f} s older ({kept}), or {what} began later"
        index = bisect.bisect_left(self._stamps, stamp_ns)
        gap = (self._stamps[index] - self._stamps[max(index - 1, 0)]) / SECOND_NS
        limit = self.max_gap_ns / SECOND_NS
        apart = f"{gap:.3f} s apart, limit {limit:.3f} s"
        return f"{held}: the {what} around it are {apart}"

    def _bracket(self, stamp_ns: int) -> tuple[Pose, Pose] | None:
        """Return the poses before and after a stamp, the same twice if one has it; else None."""
        index = bisect.bisect_left(self._stamps, stamp_ns)
        if index == len(self._stamps):
            return None
        before = index if self._stamps[index] == stamp_ns else index - 1
        if before < 0 or self._stamps[index] - self._stamps[before] > self.max_gap_ns:
            return None
        return self._poses[before], self._poses[index]

    def _trim(self) -> None:
        oldest = self._stamps[-1] - self.span_ns
        if self._stamps[0] >= oldest and len(self._stamps) <= MAX_POSES:
            return
        keep = max(bisect.bisect_left(self._stamps, oldest), len(self._stamps) - MAX_POSES)
        del self._stamps[:keep]
        del self._poses[:keep]
