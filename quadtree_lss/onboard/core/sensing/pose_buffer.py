# SPDX-License-Identifier: Apache-2.0
"""Poses by their stamps, and the pose at any stamp between two of them."""

from __future__ import annotations

import bisect

from quadtree_lss.onboard.core.geometry.rotations import slerp
from quadtree_lss.onboard.core.sensing.lidar import Pose

SECOND_NS = 1_000_000_000
MAX_POSES = 100_000


def seconds(stamp_ns: int) -> str:
    """A stamp as text, to the microsecond."""
    return f"{stamp_ns // SECOND_NS}.{stamp_ns % SECOND_NS // 1000:06d} s"


def interpolate(before: Pose, after: Pose, stamp_ns: int) -> Pose:
    """Pose between two: position and covariance linearly, rotation at constant rate.

    The blend of two covariances with weights that sum to one is a covariance again.
    """
    share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    return Pose(
        stamp_ns,
        (1.0 - share) * before.position + share * after.position,
        slerp(before.rotation_map_lidar, after.rotation_map_lidar, share),
        (1.0 - share) * before.covariance + share * after.covariance,
    )


class PoseBuffer:
    """The poses of the last ``span_ns``, in the order of their stamps.

    Those farther apart than ``max_gap_ns`` are not interpolated between; steps back by ``jump_ns``
    at most are late messages and sorted in. A greater one starts anew (a looping bag): everything
    before is forgotten and ``jumps`` counts it. ``what``: word for one of them in texts.
    """

    def __init__(
        self, span_ns: int, max_gap_ns: int, jump_ns: int = SECOND_NS, what: str = "pose"
    ) -> None:
        self.span_ns = span_ns
        self.max_gap_ns = max_gap_ns
        self.jump_ns = jump_ns
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
        """Forgets every pose."""
        self._stamps.clear()
        self._poses.clear()

    def add(self, pose: Pose) -> str | None:
        """Takes a pose; the answer is None, or why it was not simply appended.

        ``duplicate``: a pose of this stamp is held, the new one is ignored. ``too_old``: older
        than all that are held, ignored. ``time_jump``: taken, all others forgotten.
        """
        stamp = pose.stamp_ns
        if not self._stamps or stamp > self._stamps[-1]:
            self._stamps.append(stamp)
            self._poses.append(pose)
            self._trim()
            return None
        if stamp < self._stamps[-1] - self.jump_ns:
            self.clear()
            self.jumps += 1
            self.add(pose)
            return "time_jump"
        place = bisect.bisect_left(self._stamps, stamp)
        if self._stamps[place] == stamp:
            return "duplicate"
        if place == 0:
            return "too_old"
        self._stamps.insert(place, stamp)
        self._poses.insert(place, pose)
        return None

    def pose_at(self, stamp_ns: int) -> Pose | None:
        """Pose of exactly this stamp, else between the two around it, else None.

        Never the latest pose, never beyond either end. With poses that arrive in the order of
        their stamps the answer, once there is one, does not depend on when it is asked for.
        """
        around = self._bracket(stamp_ns)
        if around is None:
            return None
        before, after = around
        return after if after.stamp_ns == stamp_ns else interpolate(before, after, stamp_ns)

    def covers(self, stamp_ns: int) -> bool:
        """True if ``at`` has an answer."""
        return self._bracket(stamp_ns) is not None

    def stamps_between(self, first_ns: int, last_ns: int) -> list[int]:
        """Stamps of the poses that lie between, both ends excluded."""
        start = bisect.bisect_right(self._stamps, first_ns)
        return self._stamps[start : bisect.bisect_left(self._stamps, last_ns)]

    def timeout_reason(self, stamp_ns: int) -> str:
        """``no_pose``: the key to count a scan by that has waited for one in vain."""
        return "no_pose"

    def drop_reason(self, stamp_ns: int) -> str | None:
        """``before_poses`` or ``pose_gap`` if later poses cannot help any more, else None."""
        if not self._stamps or self._stamps[-1] < stamp_ns or self.covers(stamp_ns):
            return None
        return "before_poses" if stamp_ns < self._stamps[0] else "pose_gap"

    def explain(self, stamp_ns: int, topic: str) -> str:
        """One clause for a log line: stamps held on ``topic`` and the likely cause."""
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
        place = bisect.bisect_left(self._stamps, stamp_ns)
        gap = (self._stamps[place] - self._stamps[max(place - 1, 0)]) / SECOND_NS
        limit = self.max_gap_ns / SECOND_NS
        apart = f"{gap:.3f} s apart, limit {limit:.3f} s"
        return f"{held}: the {what} around it are {apart}"

    def _bracket(self, stamp_ns: int) -> tuple[Pose, Pose] | None:
        """The poses to interpolate between, twice the same if one has this stamp; else None."""
        place = bisect.bisect_left(self._stamps, stamp_ns)
        if place == len(self._stamps):
            return None
        before = place if self._stamps[place] == stamp_ns else place - 1
        if before < 0 or self._stamps[place] - self._stamps[before] > self.max_gap_ns:
            return None
        return self._poses[before], self._poses[place]

    def _trim(self) -> None:
        oldest = self._stamps[-1] - self.span_ns
        if self._stamps[0] >= oldest and len(self._stamps) <= MAX_POSES:
            return
        keep = max(bisect.bisect_left(self._stamps, oldest), len(self._stamps) - MAX_POSES)
        del self._stamps[:keep]
        del self._poses[:keep]
