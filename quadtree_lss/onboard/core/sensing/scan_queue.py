# SPDX-License-Identifier: Apache-2.0
"""A queue in which scans wait for the pose at their stamp.

The caller passes arrival times and the current time: a steady clock's, or a bag's receive times.
They are never compared with stamps, because a bag has old stamps.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import Any, NamedTuple

from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import PoseSource
from quadtree_lss.onboard.core.sensing.pose_buffer import JUMP_NS, SECOND_NS, seconds
from quadtree_lss.onboard.core.sensing.sweep import find_uncovered_stamp


class Drop(NamedTuple):
    """A dropped scan: its stamp, the key of the reason for counting, and the reason in one line."""

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
    """First-in-first-out queue of scans, bounded in number and time. The caller adds to ``poses``.

    Dropped scans are counted in ``dropped`` by reason and returned by `expire`:

    - ``no_pose``: waited ``max_wait_ns`` since arrival
    - ``before_poses``, ``pose_gap``: no later pose can cover the scan
    - the same with the prefix ``gimbal_``, and ``no_mount``, if the mount is missing
    - ``queue_full``: the oldest of more than ``max_scans``
    - ``duplicate``: has the stamp of the scan before
    - ``time_jump``: waited when stamps jumped back by more than `JUMP_NS` (counted in ``jumps``)
    """

    poses: PoseSource
    max_scans: int
    max_wait_ns: int
    scan_topic: str = "lidar/points"
    pose_topic: str = "nav/pose"

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
        """Add a scan that arrived at ``arrival_ns`` (any steady clock). ``span_ns``: times of its
        first and last point relative to the stamp."""
        self._follow_pose_jump()
        last = self._last_ns
        if last is not None and stamp_ns == last:
            self._drop(stamp_ns, "duplicate", "the scan before has the same stamp")
            return
        if last is not None and stamp_ns < last - JUMP_NS:
            self._jump(stamp_ns, last)
        self._last_ns = stamp_ns
        first, last = (stamp_ns + offset for offset in span_ns)
        self._waiting.append(_Waiting(stamp_ns, scan, arrival_ns, first, last))
        if len(self._waiting) > self.max_scans:
            oldest = self._waiting.popleft()
            more = f"{self.max_scans} scans wait already (pose.max_wait); {self._explain(oldest)}"
            self._drop(oldest.stamp_ns, "queue_full", more)

    def pop_ready(self) -> list[tuple[int, Any, Pose]]:
        """Remove and return stamps, scans and poses, up to the first scan that must wait."""
        self._follow_pose_jump()
        ready: list[tuple[int, Any, Pose]] = []
        while self._waiting:
            first = self._waiting[0]
            uncovered = self._uncovered_stamp(first)
            if uncovered is not None:
                reason = self.poses.drop_reason(uncovered)
                if reason is None:
                    break
                self._drop(first.stamp_ns, reason, self._explain(first))
            elif (pose := self.poses.pose_at(first.stamp_ns)) is not None:
                ready.append((first.stamp_ns, first.scan, pose))
            self._waiting.popleft()
        return ready

    def expire(self, now_ns: int) -> list[Drop]:
        """Drop scans that have waited too long; return all drops since the last call. Call it after
        `pop_ready`, and `pop_ready` again if a scan was dropped: later ones may be ready."""
        while self._waiting and now_ns - self._waiting[0].arrival_ns >= self.max_wait_ns:
            first = self._waiting[0]
            uncovered = self._uncovered_stamp(first)
            if uncovered is None:
                break
            waited = (now_ns - first.arrival_ns) / SECOND_NS
            reason = self.poses.timeout_reason(uncovered)
            self._drop(first.stamp_ns, reason, f"waited {waited:.3f} s; {self._explain(first)}")
            self._waiting.popleft()
        return self._take_drops()

    def finish(self) -> list[Drop]:
        """Drop all waiting scans at the end of the data; return all drops since the last call."""
        while self._waiting:
            first = self._waiting.popleft()
            reason = self.poses.timeout_reason(self._uncovered_stamp(first) or first.stamp_ns)
            self._drop(first.stamp_ns, reason, f"the data end; {self._explain(first)}")
        return self._take_drops()

    def _take_drops(self) -> list[Drop]:
        drops, self._drops = self._drops, []
        return drops

    def _uncovered_stamp(self, waiting: _Waiting) -> int | None:
        """Return a stamp within the scan without a pose, None if there is none."""
        return find_uncovered_stamp(self.poses, waiting.first_ns, waiting.last_ns)

    def _explain(self, waiting: _Waiting) -> str:
        uncovered = self._uncovered_stamp(waiting)
        why = self.poses.explain(
            waiting.stamp_ns if uncovered is None else uncovered, self.pose_topic
        )
        if waiting.first_ns == waiting.last_ns:
            return why
        first, last = seconds(waiting.first_ns), seconds(waiting.last_ns)
        return f"its points are of {first} .. {last}; {why}"

    def _drop(self, stamp_ns: int, reason: str, why: str) -> None:
        self.dropped[reason] += 1
        text = f"scan {seconds(stamp_ns)} on '{self.scan_topic}' dropped: {why}"
        self._drops.append(Drop(stamp_ns, reason, text))

    def _jump(self, stamp_ns: int, last_ns: int) -> None:
        """Handle scan stamps that jumped back: drop waiting scans, and poses of the old time."""
        self.jumps += 1
        back = (last_ns - stamp_ns) / SECOND_NS
        for waiting in self._waiting:
            text = f"scan stamps jumped back by {back:.3f} s (a looping bag?)"
            self._drop(waiting.stamp_ns, "time_jump", text)
        self._waiting.clear()
        held = self.poses.range_ns
        if held is not None and held[1] > stamp_ns + JUMP_NS:
            self.poses.clear()

    def _follow_pose_jump(self) -> None:
        """Drop waiting scans of the old time if pose stamps jumped back."""
        if self._pose_jumps == self.poses.jumps:
            return
        self._pose_jumps = self.poses.jumps
        held = self.poses.range_ns
        if held is None:
            return
        limit = held[1] + JUMP_NS
        old = [w for w in self._waiting if w.stamp_ns > limit]
        self._waiting = deque(w for w in self._waiting if w.stamp_ns <= limit)
        for waiting in old:
            self._drop(waiting.stamp_ns, "time_jump", "pose stamps jumped back (a looping bag?)")
