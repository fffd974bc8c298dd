# SPDX-License-Identifier: Apache-2.0
"""Reading of a whole bag: headers, notices, and the map of the scans."""

from __future__ import annotations

import contextlib
import zlib
from collections import Counter, defaultdict
from typing import Any, NamedTuple

import numpy as np

from quadtree_lss.desk.bags.bag import Bag
from quadtree_lss.desk.bags.recorded_file import RawMessage
from quadtree_lss.desk.replay.flight import Recording
from quadtree_lss.desk.replay.stream import SECOND_NS, Part, Progress, Stream, rate
from quadtree_lss.onboard.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages.clouds import MessageError, bytes_of, stamp_ns

TYPE_NAMES = dict(
    enumerate("int8 uint8 int16 uint16 int32 uint32 float32 float64".split(), start=1)
)
"""Names of `sensor_msgs/PointField` datatypes."""
UNREADABLE_TIMES = {"times_unreasonable", "times_unknown"}
"""Keys of notices about point times that are not used."""


class Header(NamedTuple):
    """Stamp, delay of reception and frame of a message; size and layout of a cloud."""

    stamp_ns: int
    delay_s: float
    frame: str
    points: int = 0
    layout: str = ""


class Reading:
    """Reads an open bag and maps its scans, with ``lag_s`` added to the clouds' stamps.

    ``headers``: of clouds and poses, by topic; ``repeats``, ``copies``: clouds with the points of
    an earlier one, with its stamp or another one; ``notices``: texts of the intake by key;
    ``reports``: of the mapper, by scan; ``dropped``: points by reason; ``missed_at``: centre of the
    first scan outside the domain; ``roughness``: mean of the map, m; ``gap``: `Mapper.pose_gap`, m;
    ``losses``: one line for each unreadable part.
    """

    def __init__(
        self, bag: Bag, stream: Stream, lag_s: float = 0.0, progress: Progress | None = None
    ) -> None:
        self.stream, self.config, self.lag_s = stream, stream.config, lag_s
        self.headers: dict[str, list[Header]] = defaultdict(list)
        self.copies = self.repeats = 0
        self._stamps: dict[int, int] = {}  # by checksum of the points
        self.notices: dict[str, str] = {}
        self.reports: list[ScanReport] = []
        self.dropped: Counter[str] = Counter()
        self.missed_at: tuple[float, float] | None = None
        self.recording = Recording(next(t.count for t in bag.topics if t.name == stream.scans))
        mapper, intake = Mapper(self.config), stream.intake
        stream.on_message = self._on_message
        for message in Part.of(bag).messages(bag, stream.topics, progress):
            stream.process(message)
            for scan in intake.ready(message.received_ns):
                self.recording.add_scan(scan)
                report = mapper.update(scan.points_lidar, scan.pose, scan.sweep)
                self.reports.append(report)
                self.dropped.update(scan.lost(report.dropped))
                if not report.points_used and report.dropped["outside"]:
                    self.missed_at = self.missed_at or report.centre
            self._add_notices()
        intake.finish()
        self._add_notices()
        cells = mapper.snapshot()
        roughness = cells.roughness[cells.measured]
        self.domain = Domain.of(self.config.domain) if not self.reports else cells.domain
        self.roughness = float(np.nanmean(roughness)) if roughness.size else 0.0
        self.gap = (mapper.pose_gap() or (None,))[0]
        self.losses = [*bag.losses, *stream.losses]

    @property
    def points(self) -> int:
        return sum(report.points for report in self.reports)

    @property
    def contents(self) -> int:
        """Number of different clouds."""
        return len(self._stamps)

    @property
    def scan_rate(self) -> float:
        return rate([header.stamp_ns for header in self.headers[self.stream.scans]])

    def why_same_stamp(self) -> str:
        """Explain why most dropped scans have the stamp of another one; empty if they do not."""
        dropped = self.stream.intake.dropped
        if 2 * dropped.get("duplicate", 0) < sum(dropped.values()):
            return ""
        stamps = {header.stamp_ns for header in self.headers[self.stream.scans]}
        why = f"all carry the stamp {min(stamps) / SECOND_NS:.3f} s"
        why = why if len(stamps) == 1 else "earlier scans have their stamps"
        return f"{why}: check the driver's timestamp mode, and for a second publisher"

    def why_dropped(self) -> str:
        """Return the text of the most frequent reason why scans were dropped."""
        dropped = self.stream.intake.dropped
        reason = max(dropped, key=dropped.__getitem__, default="")
        return self.notices.get(reason, reason)

    def _add_notices(self) -> None:
        for notice in self.stream.intake.notices():
            self.notices.setdefault(notice.reason, notice.text)

    def _on_message(self, kind: str, msg: Any, message: RawMessage) -> None:
        with contextlib.suppress(MessageError):  # the intake counts and reports it
            if kind in ("cloud", "pose"):
                self.headers[message.topic].append(_header(msg, message.received_ns))
            if self.lag_s and kind in ("pose", "gimbal"):
                time, ns = msg.header.stamp, stamp_ns(msg.header) - round(self.lag_s * SECOND_NS)
                time.sec, time.nanosec = divmod(ns, SECOND_NS)
            if kind == "cloud":
                stamp, checksum = stamp_ns(msg.header), zlib.crc32(memoryview(bytes_of(msg.data)))
                if checksum in self._stamps:
                    self.copies += self._stamps[checksum] != stamp
                    self.repeats += self._stamps[checksum] == stamp
                self._stamps.setdefault(checksum, stamp)

            if kind == "pose":
                self.recording.add_pose(msg)


def _header(msg: Any, received_ns: int) -> Header:
    stamp, frame = stamp_ns(msg.header), one_line(msg.header.frame_id, 80)
    header = Header(stamp, (received_ns - stamp) / SECOND_NS, frame)
    if not hasattr(msg, "fields"):
        return header
    shape = f"{msg.height} x {msg.width} organised" if msg.height > 1 else "unorganised"
    order = "big" if msg.is_bigendian else "little"
    items = (f"{f.name} {TYPE_NAMES.get(f.datatype, '?')} @{f.offset}" for f in msg.fields)
    fields = one_line(", ".join(items), 400)
    layout = f"{fields}; {msg.point_step} bytes a point, {order} endian, {shape}"
    return header._replace(points=msg.width * msg.height, layout=layout)
