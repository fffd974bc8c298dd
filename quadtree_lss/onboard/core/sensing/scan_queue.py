# SPDX-License-Identifier: Apache-2.0
"""Scans wait here for the pose at their stamp.

Nothing in this file reads a clock: the caller says when a scan arrived and what time it is now,
so that a live node (steady clock) and a replay (the bag's receive times) behave alike. Stamps and
arrival times are never compared with each other: a bag plays old stamps.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import Any, NamedTuple

from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import PoseSource
from quadtree_lss.onboard.core.sensing.pose_buffer import SECOND_NS, seconds
from quadtree_lss.onboard.core.sensing.sweep import find_uncovered_stamp


class Drop(NamedTuple):
    """A scan that was given up: its stamp, a short key to count by, one line that says why."""

    stamp_ns: int
    reason: str
    text: str


class _Waiting(NamedTuple):
    stamp_ns: int
    scan: Any
    arrival_ns: int
    first_ns: int
    last_ns: int


@dataclass
class ScanQueue:
    """Scans in the order of arrival, each waiting for its pose; bounded in number and time.

    A scan never overtakes one that waits before it. Scans are dropped, counted in ``dropped`` and
    reported by `expire`: ``no_pose`` (waited ``max_wait_ns`` since arrival), ``before_poses``,
    ``pose_gap`` (no later pose can help), each with ``gimbal_`` in front if that is what lacks,
    ``queue_full`` (the oldest goes), ``duplicate`` (the stamp of the scan before) and ``time_jump``
    (waiting when stamps jumped back by more than ``jump_ns``, which ``jumps`` counts). The caller
    adds to ``poses``.
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

    def push_scan(
        self, stamp_ns: int, scan: Any, arrival_ns: int, span_ns: tuple[int, int] = (0, 0)
    ) -> None:
        """Takes a scan that arrived at ``arrival_ns`` (any steady clock). ``span_ns``: times of its
        first and last point, from the stamp, which lies between."""
        self._follow_pose_jump()
        last = self._last_ns
        if last is not None and stamp_ns == last:
            self._drop(stamp_ns, "duplicate", "the scan before has the same stamp")
            return
        if last is not None and stamp_ns < last - self.jump_ns:
            self._jump(stamp_ns, last)
        self._last_ns = stamp_ns
        first, last = (stamp_ns + offset for offset in span_ns)
        self._waiting.append(_Waiting(stamp_ns, scan, arrival_ns, first, last))
        if len(self._waiting) > self.max_scans:
            oldest = self._waiting.popleft()
            more = f"{self.max_scans} scans wait already (pose.max_wait); {self._why(oldest)}"
            self._drop(oldest.stamp_ns, "queue_full", more)

    def pop_ready(self) -> list[tuple[int, Any, Pose]]:
        """Scans whose pose is known, with it, up to the first that must wait."""
        self._follow_pose_jump()
        ready: list[tuple[int, Any, Pose]] = []
        while self._waiting:
            first = self._waiting[0]
            lacks = self._lacks(first)
            if lacks is not None:
                reason = self.poses.drop_reason(lacks)
                if reason is None:
                    break
                self._drop(first.stamp_ns, reason, self._why(first))
            elif (pose := self.poses.pose_at(first.stamp_ns)) is not None:
                ready.append((first.stamp_ns, first.scan, pose))
            self._waiting.popleft()
        return ready

    def expire(self, now_ns: int) -> list[Drop]:
        """Drops scans that have waited too long; all drops since the last call, oldest first. Call
        after `pop_ready`, and that again if anything was dropped: what waited behind may be
        ready."""
        while self._waiting and now_ns - self._waiting[0].arrival_ns >= self.max_wait_ns:
            first = self._waiting[0]
            lacks = self._lacks(first)
            if lacks is None:
                break
            waited = (now_ns - first.arrival_ns) / SECOND_NS
            reason = self.poses.timeout_reason(lacks)
            self._drop(first.stamp_ns, reason, f"waited {waited:.3f} s; {self._why(first)}")
            self._waiting.popleft()
        drops, self._drops = self._drops, []
        return drops

    def finish(self) -> list[Drop]:
        """Drops what still waits, because nothing more will come."""
        while self._waiting:
            first = self._waiting.popleft()
            reason = self.poses.timeout_reason(self._lacks(first) or first.stamp_ns)
            self._drop(first.stamp_ns, reason, f"the data end; {self._why(first)}")
        drops, self._drops = self._drops, []
        return drops

    def _lacks(self, waiting: _Waiting) -> int | None:
        """A stamp within the scan for which there is no pose."""
        return find_uncovered_stamp(self.poses, waiting.first_ns, waiting.last_ns)

    def _why(self, waiting: _Waiting) -> str:
        lacks = self._lacks(waiting)
        why = self.poses.explain(waiting.stamp_ns if lacks is None else lacks, self.pose_topic)
        if waiting.first_ns == waiting.last_ns:
            return why
        first, last = seconds(waiting.first_ns), seconds(waiting.last_ns)
        return f"its points are of {first} .. {last}; {why}"

    def _drop(self, stamp_ns: int, reason: str, why: str) -> None:
        self.dropped[reason] += 1
        text = f"scan {seconds(stamp_ns)} on '{self.scan_topic}' dropped: {why}"
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
