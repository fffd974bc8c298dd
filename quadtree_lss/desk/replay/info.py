# SPDX-License-Identifier: Apache-2.0
"""What a bag contains and whether it is ready to replay: by the replay's own reading of it."""

from __future__ import annotations

import contextlib
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.desk.bags.bag import Bag, BagError
from quadtree_lss.desk.bags.cloud_files import open_recording
from quadtree_lss.desk.bags.message_types import POSE_TYPES, SCAN_TYPES
from quadtree_lss.desk.bags.recorded_file import RawMessage
from quadtree_lss.desk.replay.diagnosis import diagnose as diagnose_bag
from quadtree_lss.desk.replay.faults import Finding, make_setting
from quadtree_lss.desk.replay.files import plain
from quadtree_lss.desk.replay.results import points_line, points_warning
from quadtree_lss.desk.replay.stream import SECOND_NS, MapPairs, Part, Progress, Stream, rate
from quadtree_lss.desk.replay.suggest import Suggestion
from quadtree_lss.onboard.config.settings import DEFAULTS, Config
from quadtree_lss.onboard.core.sensing.register import register
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages.clouds import MessageError, stamp_ns
from quadtree_lss.onboard.messages.intake import GAP_NS
from quadtree_lss.onboard.messages.lost_points import likely_reason

TYPE_NAMES = "int8 uint8 int16 uint16 int32 uint32 float32 float64".split()
"""Of the fields of clouds, by their numbers from 1 on."""


@dataclass
class TopicInfo:
    """One topic. Stamps and what follows them are known for the topics that a replay would use.

    ``rate``: by stamps, of unused clouds and poses by reception, Hz; ``frames``: messages by frame
    name; ``backward``: number of stamps smaller than the one before; ``delay``: median of reception
    minus stamp, s; ``layout``: fields of a cloud; ``points``: their median number.
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

    def tell(self, headers: Sequence[tuple[Any, ...]]) -> None:
        """Set the values by the headers of the messages."""
        stamps, delays, frames, *cloud = zip(*headers, strict=True)
        self.frames = dict(Counter(frames).most_common())
        self.first_stamp_ns, self.last_stamp_ns = min(stamps), max(stamps)
        self.backward = sum(after < before for before, after in pairwise(stamps))
        self.delay, self.rate = float(np.median(delays)), rate(stamps)
        if cloud:
            self.points = float(np.median(cloud[0]))
            self.layout = "; or ".join(name for name, _ in Counter(cloud[1]).most_common(3))

    def lines(self, width: int) -> list[str]:
        """As text, with the name in a column of ``width``."""
        often = "" if self.rate != self.rate else f"{self.rate:.2f} Hz"
        name, kind = one_line(self.name, 80), one_line(self.type, 80)
        lines = [f"  {name:{width}} {self.count:7d} {often:>11}  {kind}"]
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

    ``kind`` is what it would read: ``scans``, ``maps`` or ``nothing``; of two topics, empty if not
    found. Some scans could be mapped (``scans_with_pose``, with ``points``), others not
    (``scans_dropped``, by reason), and so it is with the former's points. ``findings`` say what is
    wrong, with the fix, and what to know; ``losses`` what cannot be read, one line each;
    a diagnosis adds its ``verdict``, in one line, and what it suggests.
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
        """One line for each reason why it cannot be replayed."""
        return [finding.line for finding in self.findings if finding.fatal]

    @property
    def notes(self) -> list[str]:
        """One line for each other fault or remark."""
        return [finding.line for finding in self.findings if not finding.fatal]

    @property
    def works(self) -> bool:
        """True if it can be replayed."""
        return not self.problems

    def as_dict(self) -> dict[str, Any]:
        """In JSON types."""
        told = {"works": self.works, "problems": self.problems, "notes": self.notes}
        found = {"findings": [finding._asdict() for finding in self.findings]}
        known = asdict(replace(self, suggestion=None))
        del known["suggestion"]
        content: dict[str, Any] = plain(told | known | found)
        return content

    def table(self) -> str:
        """As text."""
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
    poses: str | Path | None = None,
    diagnose: bool = False,
    progress: Progress | None = None,
) -> BagInfo:
    """Reads a bag as a replay would, without mapping; the arguments are those of `replay.replay`.
    ``diagnose``: also maps it, looks for what is wrong with the ground, and tries what is set for
    it (`diagnosis.diagnosed`). Raises `BagError`: there is nothing to read."""
    how = {"scan_topic": scan_topic, "pose_topic": pose_topic, "poses": poses}
    with open_recording(bag, poses, config.frames.map) as opened:
        info = BagInfo(
            path=str(opened.path),
            kind="nothing",
            start_ns=opened.start_ns,
            seconds=(opened.end_ns - opened.start_ns) / SECOND_NS,
            topics=[TopicInfo(t.name, t.type, t.count) for t in opened.topics],
        )
        stream, pairs = None, MapPairs.alone(opened, scan_topic)
        try:
            stream = Stream(opened, config, scan_topic, pose_topic, adapt=diagnose)
        except BagError as error:
            if pairs is None:
                info.findings.append(Finding("topics", str(error), FIXES["topics"], fatal=True))
            else:
                info.kind = "maps"
                text = "maps and no scans: replay ranks landing sites on the last map, `replay"
                info.findings.append(Finding("maps", f"{text} --record` on every one"))
        else:
            info.kind = "scans"
            info.scan_topic, info.pose_topic = stream.scans, stream.poses
            texts = _read(info, opened, stream, progress)
            if diagnose:
                diagnose_bag(info, opened, stream.config, texts, how)
        # Of clouds and poses that are not read: what they may be chosen by.
        kinds, times = (*SCAN_TYPES, *POSE_TYPES), defaultdict(list)
        unread = [t for t in info.topics if t.first_stamp_ns is None and t.type in kinds]
        for message in opened.messages([topic.name for topic in unread]):
            times[message.topic].append(message.received_ns)
        for topic in unread:
            topic.rate = rate(times[topic.name])
        info.losses = [*opened.losses, *([] if stream is None else stream.losses)]
        notes = [*opened.notes, *(() if stream is None else stream.notes)]
        info.findings += [Finding("bag", text) for text in notes]
    return info


def _read(
    info: BagInfo,
    bag: Bag,
    stream: Stream,
    progress: Progress | None,
) -> dict[str, str]:
    """Read the messages and where their points lie; return the intake's notices by their keys."""
    intake, config = stream.intake, stream.config
    domain = Domain.of(config.domain)
    dropped: Counter[str] = Counter()
    missed_at: tuple[float, float] | None = None
    why = ""
    headers: dict[str, list[tuple[Any, ...]]] = defaultdict(list)
    texts: dict[str, str] = {}

    def note() -> None:
        for notice in intake.notices():
            texts.setdefault(notice.reason, notice.text)

    def hear(what: str, msg: Any, message: RawMessage) -> None:
        if what in ("cloud", "pose"):
            with contextlib.suppress(MessageError):  # counted and told by the intake
                headers[message.topic].append(_header(msg, message.received_ns))

    stream.hear = hear
    for message in Part.of(bag).messages(bag, stream.topics, progress):
        stream.take(message)
        for ready in intake.ready(message.received_ns):
            info.scans_with_pose += 1
            if config.domain.follow == "vehicle":
                domain = domain.moved(*domain.steps_to(*ready.pose.position[:2].tolist()))
            scan, lost = register(ready.points_lidar, ready.pose, config.lidar, domain, ready.sweep)
            info.points += ready.points_lidar.size // 3
            dropped.update(ready.lost(lost))
            if not why and not len(scan.key) and (lost.get("outside") or lost.get("above")):
                missed_at = scan.centre
                why = likely_reason(ready.points_lidar, ready.pose, config)
        note()
    intake.finish()
    note()
    info.scans_dropped, info.points_dropped = dict(intake.dropped), dict(dropped)
    for topic in info.topics:
        if headers[topic.name]:
            topic.tell(headers[topic.name])
    rejected, scans = intake.rejected, intake.scans
    rare = {key for key in rejected if key.startswith("times_") and 2 * rejected[key] < scans}
    info.findings += _judge(info, texts, rare)
    if frame := stream.settings.get("frames.map"):
        text, values = f"poses are in frame '{frame}', not in frames.map", {"frames.map": frame}
        info.findings.append(make_setting("pose_frame", text, values))
    warning = points_warning(info.points, dropped, domain, missed_at, why)
    if warning is not None:
        elsewhere = max(dropped, key=dropped.__getitem__) == "outside"
        fix = FIXES["outside"] if elsewhere else ""
        fatal = info.points == dropped.total()
        info.findings.append(Finding("outside", warning, fix, fatal))
    return texts


def _header(msg: Any, received_ns: int) -> tuple[Any, ...]:
    """Stamp, delay of reception and frame of a message, and of a cloud its points and layout."""
    stamp, frame = stamp_ns(msg.header), one_line(msg.header.frame_id, 80)
    told = stamp, (received_ns - stamp) / SECOND_NS, frame
    if not hasattr(msg, "fields"):
        return told
    shape = f"{msg.height} x {msg.width} organised" if msg.height > 1 else "unorganised"
    order = "big" if msg.is_bigendian else "little"
    names = dict(enumerate(TYPE_NAMES, 1))
    items = (f"{f.name} {names.get(f.datatype, '?')} @{f.offset}" for f in msg.fields)
    fields = one_line(", ".join(items), 400)
    layout = f"{fields}; {msg.point_step} bytes a point, {order} endian, {shape}"
    return *told, msg.width * msg.height, layout


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
"""Fixes by the key of a finding or of the intake's notice."""


def _judge(info: BagInfo, texts: dict[str, str], rare: set[str]) -> list[Finding]:
    """Of headers, rates and what the intake refused; of ``rare`` notices nothing need be done."""
    by_name = {topic.name: topic for topic in info.topics}
    scans, poses = by_name[info.scan_topic], by_name[info.pose_topic]
    found, lacks = [], not info.scans_with_pose
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
    both = (scans.first_stamp_ns, scans.last_stamp_ns, poses.first_stamp_ns, poses.last_stamp_ns)
    if None not in both:
        first, last, begin, end = (value or 0 for value in both)
        between = max(first - end, begin - last) / SECOND_NS
        if between > 0.0:
            text = f"stamps of scans and poses do not overlap, {between:.3f} s lie between them"
            fix = "record poses from before the first scan until after the last"
            # Wrong is the clock that is not that of reception.
            off = max(scans, poses, key=lambda topic: abs(topic.delay))
            if 2.0 * abs(off.delay) > between:
                text += ": different clocks?"
                late = f"{abs(off.delay):.1f} s {'before' if off.delay > 0.0 else 'after'}"
                fix = f"stamp {off.name} by the clock of the other:"
                fix += f" its stamps are {late} their reception"
            found.append(Finding("clocks", text, fix, fatal=True))
    wrong_frame = lacks and "pose_frame" in texts and len(poses.frames) == 1
    for key, text in texts.items():
        fix = FIXES.get(key, "") if key not in rare else ""
        if key == "pose_frame" and wrong_frame:
            fix = f"frames.map: {next(iter(poses.frames))}"
        fatal = lacks and not key.startswith("times_")
        found.append(Finding(key, f"{key}: {text}", fix, fatal=fatal))
    if lacks and not texts:
        found.append(Finding("no_pose", "no scan has a pose at its stamp", fatal=True))
    if poses.rate < scans.rate:
        gap = GAP_NS / SECOND_NS
        text = f"poses come at {poses.rate:.1f} Hz, scans at {scans.rate:.1f} Hz: interpolation"
        fix = "raise the poses' rate above the scans'" if poses.rate * gap < 1.0 else ""
        found.append(Finding("rate", f"{text} over up to {gap:g} s", fix))
    return found
