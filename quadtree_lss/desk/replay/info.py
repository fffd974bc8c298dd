# SPDX-License-Identifier: Apache-2.0
"""Content of a bag and whether it can be replayed, read by the same code as a replay."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.desk.bags.bag import Bag, BagError, open_bag
from quadtree_lss.desk.replay.diagnosis import Header, Reading
from quadtree_lss.desk.replay.diagnosis import diagnose as diagnose_bag
from quadtree_lss.desk.replay.faults import Finding, make_setting
from quadtree_lss.desk.replay.files import plain
from quadtree_lss.desk.replay.results import points_line, points_warning, share_text
from quadtree_lss.desk.replay.stream import SECOND_NS, MapPairs, Progress, Stream, rate
from quadtree_lss.desk.replay.suggest import Suggestion
from quadtree_lss.onboard.config.settings import DEFAULTS, Config
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages.intake import GAP_NS

MIN_COPIES, MIN_ISOLATED = 0.1, 0.1
"""Least reported shares of copied clouds and of isolated points."""


@dataclass
class TopicInfo:
    """One topic. ``frames`` and the following values are known for topics that a replay would use.

    ``rate``: by stamps if known, else by number of messages, Hz; ``frames``: messages by frame
    name; ``backward``: number of stamps smaller than the previous one; ``delay``: median of
    reception minus stamp, s; ``layout``: fields of a cloud; ``points``: their median number.
    """

    name: str
    type: str
    count: int
    rate: float = float("nan")
    frames: dict[str, int] = field(default_factory=dict)
    first_stamp_ns: int | None = None
    last_stamp_ns: int | None = None
    backward: int = 0
    delay: float = float("nan")
    layout: str = ""
    points: float = float("nan")

    def add_headers(self, headers: Sequence[Header]) -> None:
        """Set the values that follow from the headers of the messages."""
        stamps, delays, frames, points, layouts = zip(*headers, strict=True)
        self.frames = dict(Counter(frames).most_common())
        self.first_stamp_ns, self.last_stamp_ns = min(stamps), max(stamps)
        self.backward = sum(after < before for before, after in pairwise(stamps))
        self.delay, self.rate = float(np.median(delays)), rate(stamps)
        if any(layouts):
            self.points = float(np.median(points))
            self.layout = "; or ".join(name for name, _ in Counter(layouts).most_common(3))

    def lines(self, width: int) -> list[str]:
        """Format as lines, with the name in a column of ``width``."""
        rate_text = "" if self.rate != self.rate else f"{self.rate:.2f} Hz"
        name, kind = one_line(self.name, 80), one_line(self.type, 80)
        lines = [f"  {name:{width}} {self.count:7d} {rate_text:>11}  {kind}"]
        if self.first_stamp_ns is not None and self.last_stamp_ns is not None:
            frames = ", ".join(map(repr, self.frames))
            order = f"{self.backward} go back" if self.backward else "in order"
            first, last = self.first_stamp_ns / SECOND_NS, self.last_stamp_ns / SECOND_NS
            text = f"      stamps {first:.3f} … {last:.3f} s, {order};"
            lines.append(f"{text} received {self.delay:.3f} s later; frame {frames}")
            if self.layout:
                lines.append(f"      {self.points:.0f} points: {self.layout}")
        return lines


@dataclass
class BagInfo:
    """Content of a bag and what a replay would read of it.

    ``kind``: ``scans``, ``maps`` or ``nothing``; the two topics are empty if not found.
    ``scans_with_pose``: number of mapped scans, with ``points`` in total; dropped scans and points
    by reason. ``findings``: faults and notes; ``losses``: one line for each part that cannot be
    read; ``verdict``, in one line, and ``suggestion``: of a diagnosis.
    """

    path: str
    kind: str
    start_ns: int
    seconds: float
    topics: list[TopicInfo]
    scan_topic: str = ""
    pose_topic: str = ""
    scans_with_pose: int = 0
    scans_dropped: dict[str, int] = field(default_factory=dict)
    points: int = 0
    points_dropped: dict[str, int] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)
    losses: list[str] = field(default_factory=list)
    verdict: str = ""
    suggestion: Suggestion | None = None

    @property
    def problems(self) -> list[str]:
        """One line for each reason why the bag cannot be replayed."""
        return [finding.line for finding in self.findings if finding.fatal]

    @property
    def notes(self) -> list[str]:
        """One line for each other finding."""
        return [finding.line for finding in self.findings if not finding.fatal]

    @property
    def works(self) -> bool:
        return not self.problems

    def add(self, reading: Reading) -> None:
        """Add the content of a reading, and faults of headers, rates and messages."""
        self.scans_with_pose = len(reading.reports)
        self.scans_dropped = dict(reading.stream.intake.dropped)
        self.points, self.points_dropped = reading.points, dict(reading.dropped)
        self.losses = reading.losses
        for topic in self.topics:
            if headers := reading.headers.get(topic.name):
                topic.add_headers(headers)
        self.findings += _find_message_faults(self, reading)

    def as_dict(self) -> dict[str, Any]:
        derived = {"works": self.works, "problems": self.problems, "notes": self.notes}
        fields = {**vars(self), "topics": [vars(topic) for topic in self.topics]}
        del fields["suggestion"]
        return dict(plain(derived | fields))

    def table(self) -> str:
        when = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(self.start_ns / SECOND_NS))
        lines = [f"{one_line(self.path)}: {self.seconds:.2f} s from {when} UTC"]
        width = max(len(one_line(topic.name, 80)) for topic in self.topics)
        lines += [line for topic in self.topics for line in topic.lines(width)]
        if self.kind == "scans":
            dropped = ", ".join(f"{n} {reason}" for reason, n in self.scans_dropped.items() if n)
            names = one_line(self.scan_topic, 80), one_line(self.pose_topic, 80)
            text = "scans {}, poses {}: {} scans have a pose at their stamp; dropped: {}"
            lines.append(text.format(*names, self.scans_with_pose, dropped or "none"))
            if self.points:
                used = points_line(self.points, self.points_dropped)
                lines.append(f"{used} with this configuration")
        for word, texts in (("note", self.notes), ("damaged", self.losses)):
            lines += [one_line(f"{word}: {text}") for text in texts]
        lines += [one_line(f"problem: {text}") for text in self.problems]
        works = "ready to replay" if self.works else "cannot be replayed: see the problems above"
        return "\n".join([*lines, works])


def inspect_bag(
    bag: str | Path | Bag,
    config: Config = DEFAULTS,
    *,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    diagnose: bool = False,
    progress: Progress | None = None,
) -> BagInfo:
    """Read and map a bag as a replay would; arguments as of `replay.replay`. ``diagnose``: also
    find faults and try the setting that fixes each one (`diagnosis.diagnose`). Raises `BagError`:
    there is nothing to read."""
    chosen = {"scan_topic": scan_topic, "pose_topic": pose_topic}
    with open_bag(bag) as opened:
        seconds = (opened.end_ns - opened.start_ns) / SECOND_NS
        topics = [
            TopicInfo(t.name, t.type, t.count, t.count / seconds if seconds else float("nan"))
            for t in opened.topics
        ]
        info = BagInfo(str(opened.path), "nothing", opened.start_ns, seconds, topics)
        pairs = MapPairs.of_maps_only(opened, scan_topic)
        notes = opened.notes
        try:
            stream = Stream(opened, config, scan_topic, pose_topic, adapt=diagnose)
        except BagError as error:
            found = Finding("topics", str(error), FIXES["topics"], fatal=True)
            if pairs is not None:
                info.kind = "maps"
                text = "maps and no scans: replay ranks landing sites on the last map, `replay"
                found = Finding("maps", f"{text} --record` on every one")
            info.findings.append(found)
            info.losses = opened.losses
        else:
            info.kind, info.scan_topic, info.pose_topic = "scans", stream.scans, stream.poses
            notes = [*notes, *stream.notes]
            if frame := stream.settings.get("frames.map"):
                text = f"poses are in frame '{frame}', not in frames.map"
                info.findings.append(make_setting("pose_frame", text, {"frames.map": frame}))
            if diagnose:
                diagnose_bag(info, opened, stream.config, chosen, progress)
            else:
                info.add(Reading(opened, stream, progress=progress))
        info.findings += [Finding("bag", text) for text in notes]
    return info


FIXES = {
    "pose_quaternion": "publish unit quaternions x, y, z, w; no rotation is x, y, z: 0, w: 1",
    "pose_attitude": "publish the attitude's covariance in rad^2, or zeros where it is unknown",
    "pose_covariance": "publish a symmetric covariance without negative eigenvalues, m and rad",
    "outside": "quadtree-lss config suggest BAG writes a domain that fits",
    "topics": "name clouds and poses by --scan-topic and --pose-topic, or convert or record them"
    " (docs/connecting.md says which types are read)",
    "times_unknown": "name the field as one that is known (docs/messages/inputs.md)",
    "times_unreasonable": "send times in ns, us, ms or s from the stamp, or the same for all",
}
"""Fixes by key of a finding or of a notice of the intake."""


def _find_message_faults(info: BagInfo, reading: Reading) -> list[Finding]:
    """Find faults of headers, rates and messages."""
    by_name = {topic.name: topic for topic in info.topics}
    scans, poses = by_name[info.scan_topic], by_name[info.pose_topic]
    found, no_scans = [], not info.scans_with_pose
    for topic in (scans, poses):
        if topic.first_stamp_ns is None:
            text = f"{topic.name}: no message has a usable header"
            found.append(Finding("header", text, fatal=True))
            continue
        if topic.backward:
            found.append(Finding("order", f"{topic.name}: {topic.backward} stamps go back in time"))
        if len(topic.frames) > 1:
            text = f"{topic.name}: several frames: {', '.join(topic.frames)}"
            found.append(Finding("frames", text))
    found += _find_clock_faults(scans, poses)
    rejected, clouds = reading.stream.intake.rejected, reading.stream.intake.scans
    for key, text in reading.notices.items():
        rare = key.startswith("times_") and 2 * rejected[key] < clouds
        fix = "" if rare else FIXES.get(key, "")
        if key == "pose_frame" and no_scans and len(poses.frames) == 1:
            fix = f"frames.map: {next(iter(poses.frames))}"
        fatal = no_scans and not key.startswith("times_")
        found.append(Finding(key, f"{key}: {text}", fix, fatal=fatal))
    if no_scans and not reading.notices:
        found.append(Finding("no_pose", "no scan has a pose at its stamp", fatal=True))
    if poses.rate < scans.rate:
        gap = GAP_NS / SECOND_NS
        text = f"poses come at {poses.rate:.1f} Hz, scans at {scans.rate:.1f} Hz: interpolation"
        fix = "raise the poses' rate above the scans'" if poses.rate * gap < 1.0 else ""
        found.append(Finding("rate", f"{text} over up to {gap:g} s", fix))
    if reading.repeats:
        text = f"{reading.repeats} of {scans.count} clouds are sent again: they are mapped once"
        found.append(Finding("repeats", text))
    if reading.copies > MIN_COPIES * scans.count and reading.contents > 2:
        text = f"{reading.copies} of {scans.count} clouds have the points of another one with"
        text += " another stamp: a relay, or a second publisher"
        found.append(Finding("copies", text, "record only the topic of the lidar's driver"))
    return found + _find_unused_points(info, reading)


def _find_clock_faults(scans: TopicInfo, poses: TopicInfo) -> list[Finding]:
    """Find stamps of scans and poses that do not overlap."""
    both = (scans.first_stamp_ns, scans.last_stamp_ns, poses.first_stamp_ns, poses.last_stamp_ns)
    if None in both:
        return []
    first, last, begin, end = (value or 0 for value in both)
    between = max(first - end, begin - last) / SECOND_NS
    if between <= 0.0:
        return []
    text = f"stamps of scans and poses do not overlap, {between:.3f} s lie between them"
    fix = "record poses from before the first scan until after the last"
    # The clock that differs from that of reception is wrong.
    off = max(scans, poses, key=lambda topic: abs(topic.delay))
    if 2.0 * abs(off.delay) > between:
        text += ": different clocks?"
        late = f"{abs(off.delay):.1f} s {'before' if off.delay > 0.0 else 'after'}"
        fix = f"stamp {off.name} by the clock of the other: its stamps are {late} their reception"
    return [Finding("clocks", text, fix, fatal=True)]


def _find_unused_points(info: BagInfo, reading: Reading) -> list[Finding]:
    """Find points that do not enter the map."""
    lost, found = reading.dropped, []
    warning = points_warning(info.points, lost, reading.domain, reading.missed_at)
    if warning is not None:
        fix = FIXES["outside"] if max(lost, key=lost.__getitem__) == "outside" else ""
        fatal = info.points == lost.total()
        found.append(Finding("outside", warning, fix, fatal))
    returns = info.points - lost["no_return"]
    if not lost["above"] and lost["isolated"] > MIN_ISOLATED * returns:
        share = share_text(lost["isolated"], returns)
        text = f"{share} of the returns are isolated and not mapped, as of dust, rain or spray"
        found.append(Finding("isolated", text))
    return found
