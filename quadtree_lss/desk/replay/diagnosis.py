# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of a bag: map it unchanged and with each fix, and give a verdict."""

from __future__ import annotations

import contextlib
import math
import zlib
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from quadtree_lss.desk.bags.bag import Bag, open_bag
from quadtree_lss.desk.bags.recorded_file import RawMessage
from quadtree_lss.desk.replay.faults import Finding, find_faults, find_pose_faults, make_setting
from quadtree_lss.desk.replay.flight import Recording
from quadtree_lss.desk.replay.stream import SECOND_NS, Part, Progress, Stream, rate
from quadtree_lss.desk.replay.suggest import MIN_NOISES, Suggestion, suggest_config
from quadtree_lss.onboard.config.settings import Config, DomainConfig, config_from_values
from quadtree_lss.onboard.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.errors import QuadtreeLssError, one_line
from quadtree_lss.onboard.messages.clouds import MessageError, bytes_of, stamp_ns
from quadtree_lss.onboard.messages.intake import noise_notice

if TYPE_CHECKING:
    from quadtree_lss.desk.replay.info import BagInfo

MAX_CONTRADICTING, MIN_MAPPED = 0.05, 0.95
"""Limits of a bag without faults: share of points that contradict the map, of scans that are
mapped."""
MAX_LEFT = 0.8
"""Share of the contradicting points, the leaves or their roughness that a fix may leave."""
DISAGREEING = {
    "frames": "send the clouds of each lidar on a topic of its own",
    "jump": "use poses without jumps, or replay the parts between them (--start, --duration)",
}
"""Fixes, by key, of findings that are faults only if scans disagree."""
FITTED = ("domain.", "lidar.range_noise", "lss.grid_spacing")
"""Suggested values for a trial if the domain is the default one."""
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
    ``contents``: number of different clouds; ``reports``: of the mapper, by scan; ``dropped``:
    points by reason; ``contradicting``: share of the usable points that contradict the map;
    ``missed_at``: centre of the first scan outside the domain; ``roughness``: mean of the map, m;
    ``gap``: `Mapper.unexplained_offset`, m; ``suggestion``: None because of ``failure``.
    """

    def __init__(
        self, bag: Bag, stream: Stream, lag_s: float = 0.0, progress: Progress | None = None
    ) -> None:
        self.stream, self.config, self.lag_s = stream, stream.config, lag_s
        self.suggestion: Suggestion | None = None
        self.failure = ""
        self.headers: dict[str, list[Header]] = defaultdict(list)
        self.copies = self.repeats = 0
        self._stamps: dict[int, int] = {}  # by checksum of the points
        self.notices: dict[str, str] = {}
        self.reports: list[ScanReport] = []
        self.dropped: Counter[str] = Counter()
        self.missed_at: tuple[float, float] | None = None
        self.recording = Recording(next(t.count for t in bag.topics if t.name == stream.scans))
        mapper = Mapper(self.config)
        stream.on_message = self._on_message
        for scan in stream.ready(Part.of(bag), progress):
            self.recording.add_scan(scan)
            report = mapper.update(scan.points_lidar, scan.pose, scan.sweep)
            self.reports.append(report)
            self.dropped.update(scan.lost(report.dropped))
            if not report.points_used and report.dropped["outside"]:
                self.missed_at = self.missed_at or report.centre
        stream.intake.finish()
        for notice in stream.intake.notices():
            self.notices.setdefault(notice.reason, notice.text)
        self.points = sum(report.points for report in self.reports)
        self.points_used = sum(report.points_used for report in self.reports)
        lost = self.dropped["contradiction"]
        self.contradicting = lost / max(self.points_used + lost, 1)
        self.contents = len(self._stamps)
        self.scan_rate = rate([header.stamp_ns for header in self.headers[stream.scans]])
        cells = mapper.snapshot()
        roughness = cells.roughness[cells.measured]
        self.domain = Domain.of(self.config.domain) if not self.reports else cells.domain
        self.roughness = float(np.nanmean(roughness)) if roughness.size else 0.0
        self.gap = (mapper.unexplained_offset() or (None,))[0]
        self.losses = [*bag.losses, *stream.losses]

    @property
    def text(self) -> str:
        share = f"{100 * self.contradicting:.1f} % of the points contradict the map"
        return share if self.points_used else "no point enters the map"

    @property
    def disagreement(self) -> float | None:
        """Disagreement of the scans, m; None if they agree."""
        heights = [abs(r.offset) for r in self.reports if r.dropped.get("contradiction")]
        median = float(np.median(heights)) if self.contradicting > MAX_CONTRADICTING else 0.0
        return max(median, self.gap or 0.0) or None

    def improves_on(self, other: Reading) -> bool:
        """Return whether scans agree clearly better, or the map is clearly simpler or smoother."""
        if not self.points_used or self.contradicting > other.contradicting + 0.01:
            return False
        if not other.points_used or self.contradicting < MAX_LEFT * other.contradicting - 0.01:
            return True
        fewer = self.reports[-1].leaves < MAX_LEFT * other.reports[-1].leaves
        return fewer or self.roughness < MAX_LEFT * other.roughness

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


def try_config(
    bag: str | Path | Bag,
    requested: Config,
    topics: Mapping[str, Any],
    lag_s: float = 0.0,
    progress: Progress | None = None,
) -> Reading:
    """Map a bag with a configuration; replace the default domain by the suggested one.

    ``topics``: as of `replay.replay`. ``lag_s``: time to add to the clouds' stamps.
    """
    config, suggestion, failure = requested, None, "no return lies in the lidar's range"
    try:
        suggestion = suggest_config(bag, requested, **topics)
        if requested.domain == Config().domain:
            values = suggestion.values.items()
            config = config_from_values(
                {k: v for k, v in values if k.startswith(FITTED)}, requested
            )
    except QuadtreeLssError as error:
        failure = str(error)
    with open_bag(bag) as opened:
        stream = Stream(opened, config, **topics, adapt=True)
        trial = Reading(opened, stream, lag_s, progress)
    trial.suggestion, trial.failure = suggestion, failure
    return trial


def diagnose(
    info: BagInfo, bag: Bag, requested: Config, topics: Mapping[str, Any], progress: Progress | None
) -> None:
    """Add to ``info`` the faults that mapping an open bag confirms, a suggestion with their
    settings, and the verdict. ``topics``: as of `try_config`."""
    source: str | Bag = info.path if Path(info.path).exists() else bag
    first = try_config(source, requested, topics, progress=progress)
    info.add(first)
    before = best = _State(first, requested, _find(first, requested))
    fixes: list[Finding] = []
    while fixed := _fix(source, best, topics):
        fault, best = fixed
        fixes.append(fault)
    if first.points_used and best.trial.disagreement is not None:  # the fixes do not explain it
        best, fixes = before, []
    info.findings += fixes
    info.findings += [fault for fault in best.found if not (fault.settings or fault.lag_s)]
    info.suggestion = _match_noise(source, best.trial, best.requested, topics).suggestion
    _conclude(info, first, best.trial, requested.domain)


class _State(NamedTuple):
    """A trial, the requested configuration, and the remaining faults."""

    trial: Reading
    requested: Config
    found: list[Finding]


def _fix(
    bag: str | Path | Bag, state: _State, topics: Mapping[str, Any]
) -> tuple[Finding, _State] | None:
    """Return the first fault whose fix improves the map, and the state with the fix."""
    for fault in (fault for fault in state.found if fault.settings or fault.lag_s):
        requested = config_from_values(fault.settings or {}, state.requested)
        trial = try_config(bag, requested, topics, state.trial.lag_s + fault.lag_s)
        if trial.improves_on(state.trial):
            confirmed = fault._replace(text=f"{fault.text}; with the fix {trial.text}")
            return confirmed, _State(trial, requested, _find(trial, requested))
    return None


def _match_noise(
    bag: str | Path | Bag, best: Reading, requested: Config, topics: Mapping[str, Any]
) -> Reading:
    """Try the range noise observed in the map, which exceeds the suggested one on ground that is
    rough within a cell. Return that trial if a replay would not warn about the noise, else
    ``best``."""
    ratio = best.reports[-1].noise_ratio if best.reports else math.nan
    noise = float(f"{ratio * best.config.lidar.range_noise:.2g}")
    cell = best.config.domain.size / 2**best.config.domain.max_level
    if noise_notice(ratio, best.config) is None or not MIN_NOISES * noise < cell:
        return best
    changed = config_from_values({"lidar.range_noise": noise}, requested)
    trial = try_config(bag, changed, topics, best.lag_s)
    matched = trial.reports and noise_notice(trial.reports[-1].noise_ratio, trial.config) is None
    return trial if matched else best


def _find(trial: Reading, requested: Config) -> list[Finding]:
    """Find faults in a bag that was mapped."""
    found, lidar, recording = [], trial.config.lidar, trial.recording
    longest = trial.suggestion.values.get("lidar.max_range") if trial.suggestion else None
    if longest is not None and longest < lidar.max_range:
        text = "many returns are at one greatest range: rays without a return"
        found.append(make_setting("max_range", text, {"lidar.max_range": longest}))
        lidar = replace(lidar, max_range=longest)
    # Faults of frames make the noise appear larger.
    lidar = replace(lidar, range_noise=min(lidar.range_noise, requested.lidar.range_noise))
    found += find_pose_faults(recording.poses)
    if (flight := recording.flight(lidar)) is not None:
        period = 1.0 / trial.scan_rate
        if recording.has_times or UNREADABLE_TIMES & trial.notices.keys():
            period = 0.0 if recording.has_times else math.nan
        config, mounts = replace(trial.config, lidar=lidar), trial.stream.tf_mounts
        found += find_faults(flight, config, mounts, period)
    return found


def _conclude(info: BagInfo, first: Reading, best: Reading, domain: DomainConfig) -> None:
    """Set the verdict on the bag unchanged and with the fixes. ``domain``: the requested one."""
    mapped, disagreement = len(first.reports), first.disagreement
    total = mapped + sum(info.scans_dropped.values()) - first.repeats
    found = info.findings
    if disagreement is not None:
        found = [f._replace(fix=DISAGREEING.get(f.key, f.fix)) for f in found]
        found = [f for f in found if f.key not in ("calm", "tilt")]
    if any(f.fix and f.key != "outside" for f in found):  # the other fault explains it
        found = [f._replace(fix=f.fix * (f.key != "outside")) for f in found]
    info.findings = found
    faults = sum(bool(finding.fix) for finding in info.findings) or len(info.problems)
    see_above = f"see the {f'{faults} faults' if faults > 1 else 'fault'} above"
    figures = f"{mapped} of {total} scans mapped, {first.text}"
    figures += f"; with the fixes {best.text}" if best is not first else ""
    figures += ", in the domain that `config suggest` writes" * (first.config.domain != domain)
    key = ""
    if mapped and not first.points_used:
        why = see_above if faults else first.failure
        key, info.verdict = "dropped", f"no scan can be mapped: {why}"
    elif mapped < MIN_MAPPED * total:
        why = first.why_same_stamp() or (see_above if faults else first.why_dropped())
        key, info.verdict = "dropped", f"{total - mapped} of {total} scans dropped: {why}"
    elif disagreement is not None:
        key, why = "disagree", f": {see_above}" if faults else "; no common fault explains it"
        info.verdict = f"scans disagree by {disagreement:.2g} m{why} ({figures})"
    elif faults:
        info.verdict = f"{see_above}; as it is, {figures}"
    else:
        info.verdict = f"nothing is wrong with {info.scan_topic} and {info.pose_topic}: {figures}"
        if slope := next((f for f in info.findings if f.key == "tilt"), None):
            info.verdict = f"{slope.text.partition(';')[0]}: if it really does, {info.verdict}"
    if key:
        info.findings.append(Finding(key, info.verdict, fatal=True))
