# SPDX-License-Identifier: Apache-2.0
"""What a bag contains and whether it is ready to replay: by the replay's own reading of it."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.desk.bags.bag import Bag, BagError
from quadtree_lss.desk.bags.cloud_files import open_recording
from quadtree_lss.desk.bags.message_types import GIMBAL_TYPE, POSE_TYPES, SCAN_TYPE, SCAN_TYPES
from quadtree_lss.desk.bags.recorded_file import RawMessage
from quadtree_lss.desk.replay.doctor import Finding, Heard
from quadtree_lss.desk.replay.files import plain
from quadtree_lss.desk.replay.results import points_line, points_warning
from quadtree_lss.desk.replay.stream import SECOND_NS, MapPairs, Part, Progress, Stream, rate
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.sensing.register import register
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages.clouds import MessageError, stamp_ns
from quadtree_lss.onboard.messages.intake import GAP_NS
from quadtree_lss.onboard.messages.lost_points import likely_reason

TYPE_NAMES = {1: "int8", 2: "uint8", 3: "int16", 4: "uint16", 5: "int32", 6: "uint32"}
TYPE_NAMES |= {7: "float32", 8: "float64"}


@dataclass
class TopicInfo:
    """One topic; stamps are known for the topics that would be used.

    ``rate`` is by the stamps, Hz; of clouds and poses that would not be used by their reception, of
    other topics unknown. ``frames`` counts the messages of each frame name, ``backward`` the stamps
    smaller than the one before. ``delay`` is the median time of reception less stamp, s; ``layout``
    a cloud's fields with type and offset, size and organisation; ``points`` their median number.
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


@dataclass
class BagInfo:
    """Content of a bag and what a replay would make of it.

    ``kind`` is what it would read: ``scans``, ``maps`` or ``nothing``; of two topics, empty if not
    found. Some scans could be mapped (``scans_with_pose``, with ``points``), others not
    (``scans_dropped``, by reason), and so it is with the former's points. ``findings`` say what is
    wrong, with what mends it, and what to know; ``losses`` what cannot be read, one line each.
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

    @property
    def problems(self) -> list[str]:
        """Why it cannot be replayed, one line each; empty if it can."""
        return [finding.line for finding in self.findings if finding.fatal]

    @property
    def notes(self) -> list[str]:
        """What else is wrong, or to know, one line each."""
        return [finding.line for finding in self.findings if not finding.fatal]

    @property
    def works(self) -> bool:
        """Whether a replay would give landing sites or say that there are none."""
        return not self.problems

    def as_dict(self) -> dict[str, Any]:
        """In JSON's types."""
        told = {"works": self.works, "problems": self.problems, "notes": self.notes}
        found = {"findings": [finding._asdict() for finding in self.findings]}
        content: dict[str, Any] = plain(told | asdict(self) | found)
        return content

    def table(self) -> str:
        """For people."""
        return "\n".join(_lines(self))


def inspect_bag(
    bag: str | Path | Bag,
    config: Config,
    *,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    poses: str | Path | None = None,
    progress: Progress | None = None,
) -> BagInfo:
    """Reads a bag as a replay would, without mapping; the arguments are those of `replay.replay`.
    Raises `BagError`: there is nothing to read."""
    with open_recording(bag, poses, config.frames.map) as opened:
        info = BagInfo(
            path=str(opened.path),
            kind="nothing",
            start_ns=opened.start_ns,
            seconds=(opened.end_ns - opened.start_ns) / SECOND_NS,
            topics=[TopicInfo(t.name, t.type, t.count) for t in opened.topics],
        )
        stream, pairs = None, MapPairs.alone(opened) if scan_topic is None else None
        try:
            stream = Stream(opened, config, scan_topic, pose_topic)
        except BagError as error:
            if pairs is None:
                info.findings.append(Finding("topics", str(error), fatal=True))
            else:
                info.kind = "maps"
                text = "maps and no scans: replay ranks landing sites on the last map, `replay"
                info.findings.append(Finding("maps", f"{text} --record` on every one"))
        else:
            info.kind = "scans"
            info.scan_topic, info.pose_topic = stream.scans, stream.poses
            _read(info, opened, stream, config, progress)
        _rates_by_reception(info, opened)
        info.losses = [*opened.losses, *([] if stream is None else stream.losses)]
        info.findings += [Finding("bag", text) for text in opened.notes]
    return info


def _rates_by_reception(info: BagInfo, bag: Bag) -> None:
    """Of the clouds and poses that are not read: what they may be chosen by."""
    kinds = (*SCAN_TYPES, *POSE_TYPES)
    unread = [t for t in info.topics if t.first_stamp_ns is None and t.type in kinds]
    times: dict[str, list[int]] = {topic.name: [] for topic in unread}
    for message in bag.messages(list(times)):
        times[message.topic].append(message.received_ns)
    for topic in unread:
        topic.rate = rate(times[topic.name])


def _read(
    info: BagInfo, bag: Bag, stream: Stream, config: Config, progress: Progress | None
) -> None:
    intake, heard = stream.intake, Heard()
    domain = Domain.of(config.domain)
    dropped: Counter[str] = Counter()
    missed_at: tuple[float, float] | None = None
    why = ""
    seen = {topic.name: _Stamps() for topic in info.topics}
    texts: dict[str, str] = {}

    def note() -> None:
        for notice in intake.notices():
            texts.setdefault(notice.reason, notice.text)

    for message in Part.of(bag).messages(bag, stream.topics, progress):
        with contextlib.suppress(MessageError):  # counted and told by the intake
            _hear(heard, bag, message, stream, seen[message.topic])
        stream.take(message)
        for ready in intake.ready(message.received_ns):
            info.scans_with_pose += 1
            if config.domain.follow == "vehicle":
                domain = domain.moved(*domain.steps_to(*ready.pose.position[:2].tolist()))
            scan, lost = register(ready.points_lidar, ready.pose, config.lidar, domain, ready.sweep)
            info.points += ready.points_lidar.size // 3
            dropped.update(ready.lost(lost))
            if not why and not len(scan.key):
                missed_at = scan.centre
                why = likely_reason(ready.points_lidar, ready.pose, config)
        note()
    intake.finish()
    note()
    info.scans_dropped, info.points_dropped = dict(intake.dropped), dict(dropped)
    for topic in info.topics:
        seen[topic.name].tell(topic)
    heard.mount = intake.mount
    info.findings += _judge(info, texts, config)
    wrong = heard.findings(config)
    warning = points_warning(info.points, dropped, domain, missed_at, why)
    if warning is not None:
        mend = "" if wrong else MENDS["outside"]
        fatal = info.points == dropped.total()
        wrong.append(Finding("outside", warning, mend, fatal))
    info.findings += wrong


def _hear(heard: Heard, bag: Bag, message: RawMessage, stream: Stream, seen: _Stamps) -> None:
    """A message as it stands. Raises `MessageError`: it cannot be read."""
    if message.topic == stream.gimbal:
        heard.add_gimbal(bag.decode(message.raw, GIMBAL_TYPE))
        return
    if message.topic == stream.camera:
        return
    kind = stream.scan_type if message.topic == stream.scans else stream.pose_type
    msg = bag.decode(message.raw, kind)
    seen.add(msg, message.received_ns)
    if kind == SCAN_TYPE:
        heard.add_cloud(msg)
    elif kind not in SCAN_TYPES:
        heard.add_pose(msg)


class _Stamps:
    """What the messages of a topic have in their headers."""

    def __init__(self) -> None:
        self.stamps: list[int] = []
        self.delays: list[float] = []
        self.points: list[int] = []
        self.frames: Counter[str] = Counter()
        self.layouts: Counter[str] = Counter()

    def add(self, msg: Any, received_ns: int) -> None:
        stamp = stamp_ns(msg.header)
        self.stamps.append(stamp)
        self.delays.append((received_ns - stamp) / SECOND_NS)
        self.frames[one_line(msg.header.frame_id, 80)] += 1
        if hasattr(msg, "fields"):
            self.points.append(msg.width * msg.height)
            self.layouts[_layout(msg)] += 1

    def tell(self, topic: TopicInfo) -> None:
        if not self.stamps:
            return
        stamps = np.array(self.stamps, dtype=np.int64)
        topic.frames = dict(self.frames.most_common())
        topic.first_stamp_ns, topic.last_stamp_ns = int(stamps.min()), int(stamps.max())
        topic.backward = int(np.count_nonzero(np.diff(stamps) < 0))
        topic.delay = float(np.median(self.delays))
        topic.rate = rate(self.stamps)
        if self.points:
            topic.points = float(np.median(self.points))
            topic.layout = "; or ".join(name for name, _ in self.layouts.most_common(3))


def _layout(msg: Any) -> str:
    shape = f"{msg.height} x {msg.width} organised" if msg.height > 1 else "unorganised"
    order = "big" if msg.is_bigendian else "little"
    items = (f"{f.name} {TYPE_NAMES.get(f.datatype, '?')} @{f.offset}" for f in msg.fields)
    fields = one_line(", ".join(items), 400)
    return f"{fields}; {msg.point_step} bytes a point, {order} endian, {shape}"


MENDS = {
    "pose_quaternion": "publish unit quaternions x, y, z, w; no rotation is x, y, z: 0, w: 1",
    "pose_attitude": "publish the attitude's covariance in rad^2, or zeros where it is unknown",
    "pose_covariance": "publish a symmetric covariance without negative eigenvalues, m and rad",
    "outside": "quadtree-lss config suggest BAG writes a domain that fits",
}
"""What mends that which the intake tells, by its keys."""


def _judge(info: BagInfo, texts: dict[str, str], config: Config) -> list[Finding]:
    """Of headers, rates and what the intake refused."""
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
            text = f"stamps of scans and poses do not overlap, {between:.3f} s lie between them:"
            mend = _clock_mend(scans, poses)
            found.append(Finding("clocks", f"{text} different clocks?", mend, fatal=True))
    wrong_frame = lacks and "pose_frame" in texts and len(poses.frames) == 1
    for key, text in texts.items():
        mend = MENDS.get(key, "")
        if key == "pose_frame" and wrong_frame:
            mend = f"frames.map: {next(iter(poses.frames))}"
        found.append(Finding(key, f"{key}: {text}", mend, fatal=lacks))
    if lacks and not texts:
        found.append(Finding("no_pose", "no scan has a pose at its stamp", fatal=True))
    if poses.rate < scans.rate:
        gap = GAP_NS / SECOND_NS
        text = f"poses come at {poses.rate:.1f} Hz, scans at {scans.rate:.1f} Hz: interpolation"
        mend = "raise the poses' rate above the scans'" if poses.rate * gap < 1.0 else ""
        found.append(Finding("rate", f"{text} over up to {gap:g} s", mend))
    return found


def _clock_mend(scans: TopicInfo, poses: TopicInfo) -> str:
    """By which of the two clocks is not that of reception."""
    off = max(scans, poses, key=lambda topic: abs(topic.delay))
    late = f"{abs(off.delay):.1f} s {'before' if off.delay > 0.0 else 'after'} their reception"
    return f"stamp {off.name} by the clock of the other: its stamps are {late}"


def _lines(info: BagInfo) -> list[str]:
    when = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime(info.start_ns / SECOND_NS))
    lines = [f"{one_line(info.path)}: {info.seconds:.2f} s from {when} UTC"]
    names = [one_line(topic.name, 80) for topic in info.topics]
    width = max(map(len, names))
    for topic, name in zip(info.topics, names, strict=True):
        rate = "" if topic.rate != topic.rate else f"{topic.rate:.2f} Hz"
        lines.append(f"  {name:{width}} {topic.count:7d} {rate:>11}  {one_line(topic.type, 80)}")
        if topic.first_stamp_ns is None or topic.last_stamp_ns is None:
            continue
        frames = ", ".join(f"{name!r}" for name in topic.frames)
        order = f"{topic.backward} go back" if topic.backward else "in order"
        first, last = (f"{t / SECOND_NS:.3f}" for t in (topic.first_stamp_ns, topic.last_stamp_ns))
        lines.append(
            f"      stamps {first} … {last} s, {order};"
            f" received {topic.delay:.3f} s later; frame {frames}"
        )
        if topic.layout:
            lines.append(f"      {topic.points:.0f} points: {topic.layout}")
    if info.kind == "scans":
        dropped = ", ".join(f"{n} {reason}" for reason, n in info.scans_dropped.items() if n)
        lines.append(
            f"scans {one_line(info.scan_topic, 80)}, poses {one_line(info.pose_topic, 80)}:"
            f" {info.scans_with_pose} scans have a pose at their stamp;"
            f" dropped: {dropped or 'none'}"
        )
        if info.points:
            lines.append(f"{points_line(info.points, info.points_dropped)} with this configuration")
    lines += [one_line(f"note: {line}") for line in info.notes]
    lines += [one_line(f"damaged: {line}") for line in info.losses]
    lines += [one_line(f"problem: {line}") for line in info.problems]
    lines.append("ready to replay" if info.works else "cannot be replayed: see the problems above")
    return lines
