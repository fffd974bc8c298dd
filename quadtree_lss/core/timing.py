# SPDX-License-Identifier: Apache-2.0
"""Scans wait here for the pose at their stamp.

Nothing in this file reads a clock: the caller says when a scan arrived and what time it is now,
so that a live node (steady clock) and a replay (the bag's receive times) behave alike. Stamps and
arrival times are never compared with each other: a bag plays old stamps.
"""

from __future__ import annotations

import bisect
from collections import Counter, deque
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from quadtree_lss.core.lidar import Pose
from quadtree_lss.core.rotations import slerp

SECOND_NS = 1_000_000_000
MAX_POSES = 100_000


class Drop(NamedTuple):
    """A scan that was given up: its stamp, a short key to count by, one line that says why."""

    stamp_ns: int
    reason: str
    text: str


class PoseSource(Protocol):
    """What a scan asks for its pose: `PoseBuffer`, or `mount.MountedPoses` on top of it."""

    @property
    def jumps(self) -> int:
        """How often stamps jumped back."""

    def clear(self) -> None:
        """Forgets every pose."""

    def at(self, stamp_ns: int) -> Pose | None:
        """Pose at the stamp, or None while there is none."""

    def hopeless(self, stamp_ns: int) -> str | None:
        """Short key of the reason why no later pose can help, or None while one can."""

    def explain(self, stamp_ns: int, topic: str) -> str:
        """Why there is no pose at the stamp: what is held, and the likely cause."""

    @property
    def range_ns(self) -> tuple[int, int] | None:
        """Oldest and newest stamp held."""


def _seconds(stamp_ns: int) -> str:
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

    A pose older than the newest by more than ``jump_ns`` starts anew (a looping bag): everything
    before is forgotten and ``jumps`` counts it.

    Args:
        span_ns: Poses older than the newest by more than this are forgotten.
        max_gap_ns: Poses farther apart than this are not interpolated between.
        jump_ns: Steps back by at most this are late messages and sorted in.
    """

    def __init__(self, span_ns: int, max_gap_ns: int, jump_ns: int = SECOND_NS) -> None:
        self.span_ns = span_ns
        self.max_gap_ns = max_gap_ns
        self.jump_ns = jump_ns
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

    def at(self, stamp_ns: int) -> Pose | None:
        """Pose of exactly this stamp, else between the two around it, else None.

        Never the latest pose, never beyond either end. With poses that arrive in the order of
        their stamps the answer, once there is one, does not depend on when it is asked for.
        """
        place = bisect.bisect_left(self._stamps, stamp_ns)
        if place == len(self._stamps):
            return None
        if self._stamps[place] == stamp_ns:
            return self._poses[place]
        if place == 0 or self._stamps[place] - self._stamps[place - 1] > self.max_gap_ns:
            return None
        return interpolate(self._poses[place - 1], self._poses[place], stamp_ns)

    def covers(self, stamp_ns: int) -> bool:
        """True if ``at`` has an answer."""
        place = bisect.bisect_left(self._stamps, stamp_ns)
        if place == len(self._stamps):
            return False
        if self._stamps[place] == stamp_ns:
            return True
        return place > 0 and self._stamps[place] - self._stamps[place - 1] <= self.max_gap_ns

    def hopeless(self, stamp_ns: int) -> str | None:
        """``before_poses`` or ``pose_gap`` if later poses cannot help any more, else None."""
        if not self._stamps or self._stamps[-1] < stamp_ns or self.covers(stamp_ns):
            return None
        return "before_poses" if stamp_ns < self._stamps[0] else "pose_gap"

    def explain(self, stamp_ns: int, topic: str) -> str:
        """One clause for a log line: stamps held on ``topic`` and the likely cause."""
        if not self._stamps:
            return (
                f"no pose has arrived on '{topic}': is anything publishing there, with matching"
                " QoS and frame?"
            )
        oldest, newest = self._stamps[0], self._stamps[-1]
        held = f"'{topic}' holds {_seconds(oldest)} .. {_seconds(newest)} ({len(self)} poses)"
        ahead, behind = (stamp_ns - newest) / SECOND_NS, (oldest - stamp_ns) / SECOND_NS
        if max(ahead, behind) > 2.0 * max(self.span_ns / SECOND_NS, 10.0):
            return f"{held}: the stamps come from different clocks"
        if ahead > 0.0:
            return f"{held}: poses are {ahead:.3f} s behind, late (pose.max_wait) or no longer sent"
        if behind > 0.0:
            return f"{held}: the scan is {behind:.3f} s older (pose.buffer), or poses began later"
        place = bisect.bisect_left(self._stamps, stamp_ns)
        gap = (self._stamps[place] - self._stamps[max(place - 1, 0)]) / SECOND_NS
        limit = self.max_gap_ns / SECOND_NS
        return (
            f"{held}: the poses around it are {gap:.3f} s apart, limit {limit:.3f} s (pose.max_gap)"
        )

    def _trim(self) -> None:
        oldest = self._stamps[-1] - self.span_ns
        if self._stamps[0] >= oldest and len(self._stamps) <= MAX_POSES:
            return
        keep = max(bisect.bisect_left(self._stamps, oldest), len(self._stamps) - MAX_POSES)
        del self._stamps[:keep]
        del self._poses[:keep]


class _Waiting(NamedTuple):
    stamp_ns: int
    scan: Any
    arrival_ns: int


@dataclass
class ScanQueue:
    """Scans in the order of arrival, each waiting for its pose; bounded in number and time.

    A scan never overtakes one that waits before it. Scans are dropped, counted in ``dropped`` and
    reported by `expire`: ``no_pose`` (waited ``max_wait_ns`` since arrival), ``before_poses``,
    ``pose_gap`` (no later pose can help), ``queue_full`` (the oldest goes), ``duplicate`` (the
    stamp of the scan before) and ``time_jump`` (waiting when stamps jumped back).

    Attributes:
        poses: Where poses come from; the caller adds to it.
        max_scans: Scans that may wait.
        max_wait_ns: How long each may wait after its arrival.
        scan_topic, pose_topic: Names for messages.
        jump_ns: A scan older than the last by more than this is a jump back.
        dropped: Number of dropped scans by reason.
        jumps: Backward jumps of scan stamps.
    """

    poses: PoseSource
    max_scans: int
    max_wait_ns: int
    scan_topic: str = "lidar/points"
    pose_topic: str = "nav/pose"
    jump_ns: int = SECOND_NS

    def __post_init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self.jumps = 0
        self._waiting: deque[_Waiting] = deque()
        self._drops: list[Drop] = []
        self._last_ns: int | None = None
        self._pose_jumps = self.poses.jumps

    def __len__(self) -> int:
        return len(self._waiting)

    def push_scan(self, stamp_ns: int, scan: Any, arrival_ns: int) -> None:
        """Takes a scan that arrived at ``arrival_ns`` (any steady clock)."""
        self._follow_pose_jump()
        last = self._last_ns
        if last is not None and stamp_ns == last:
            self._drop(stamp_ns, "duplicate", "the scan before has the same stamp")
            return
        if last is not None and stamp_ns < last - self.jump_ns:
            self._jump(stamp_ns, last)
        self._last_ns = stamp_ns
        self._waiting.append(_Waiting(stamp_ns, scan, arrival_ns))
        if len(self._waiting) > self.max_scans:
            oldest = self._waiting.popleft()
            why = self.poses.explain(oldest.stamp_ns, self.pose_topic)
            more = f"{self.max_scans} scans wait already (pose.queue); {why}"
            self._drop(oldest.stamp_ns, "queue_full", more)

    def pop_ready(self) -> list[tuple[int, Any, Pose]]:
        """Scans whose pose is known, with it, up to the first that must wait."""
        self._follow_pose_jump()
        ready: list[tuple[int, Any, Pose]] = []
        while self._waiting:
            first = self._waiting[0]
            pose = self.poses.at(first.stamp_ns)
            if pose is not None:
                ready.append((first.stamp_ns, first.scan, pose))
            else:
                reason = self.poses.hopeless(first.stamp_ns)
                if reason is None:
                    break
                self._drop(first.stamp_ns, reason, self._why(first))
            self._waiting.popleft()
        return ready

    def expire(self, now_ns: int) -> list[Drop]:
        """Drops scans that have waited too long; all drops since the last call, oldest first.

        Call after `pop_ready`, and `pop_ready` again if anything was dropped: what waited behind
        may be ready.
        """
        while self._waiting and now_ns - self._waiting[0].arrival_ns >= self.max_wait_ns:
            first = self._waiting[0]
            if self.poses.at(first.stamp_ns) is not None:
                break
            waited = (now_ns - first.arrival_ns) / SECOND_NS
            self._drop(first.stamp_ns, "no_pose", f"waited {waited:.3f} s; {self._why(first)}")
            self._waiting.popleft()
        drops, self._drops = self._drops, []
        return drops

    def finish(self) -> list[Drop]:
        """Drops what still waits, because nothing more will come."""
        while self._waiting:
            first = self._waiting.popleft()
            self._drop(first.stamp_ns, "no_pose", f"the data end; {self._why(first)}")
        drops, self._drops = self._drops, []
        return drops

    def _why(self, waiting: _Waiting) -> str:
        return self.poses.explain(waiting.stamp_ns, self.pose_topic)

    def _drop(self, stamp_ns: int, reason: str, why: str) -> None:
        self.dropped[reason] += 1
        text = f"scan {_seconds(stamp_ns)} on '{self.scan_topic}' dropped: {why}"
        self._drops.append(Drop(stamp_ns, reason, text))

    def _jump(self, stamp_ns: int, last_ns: int) -> None:
        """Scan stamps went back: what waits is of the old time, and so are poses ahead of it."""
        self.jumps += 1
        back = (last_ns - stamp_ns) / SECOND_NS
        for waiting in self._waiting:
            text = f"scan stamps jumped back by {back:.3f} s (a looping bag?)"
            self._drop(waiting.stamp_ns, "time_jump", text)
        self._waiting.clear()
        held = self.poses.range_ns
        if held is not None and held[1] > stamp_ns + self.jump_ns:
            self.poses.clear()

    def _follow_pose_jump(self) -> None:
        """Pose stamps went back: drops the scans that wait with a stamp of the old time."""
        if self._pose_jumps == self.poses.jumps:
            return
        self._pose_jumps = self.poses.jumps
        held = self.poses.range_ns
        if held is None:
            return
        limit = held[1] + self.jump_ns
        old = [w for w in self._waiting if w.stamp_ns > limit]
        self._waiting = deque(w for w in self._waiting if w.stamp_ns <= limit)
        for waiting in old:
            self._drop(waiting.stamp_ns, "time_jump", "pose stamps jumped back (a looping bag?)")
