# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of a bag: map it as it is and with each fix, and conclude with a verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from quadtree_lss.desk.bags.bag import Bag
from quadtree_lss.desk.bags.cloud_files import NO_POSES, open_recording
from quadtree_lss.desk.bags.recorded_file import RawMessage
from quadtree_lss.desk.replay.faults import Finding, find_faults, find_pose_faults, make_setting
from quadtree_lss.desk.replay.flight import Recording
from quadtree_lss.desk.replay.stream import SECOND_NS, Part, Stream
from quadtree_lss.desk.replay.suggest import NOISES, Suggestion, suggest_config
from quadtree_lss.onboard.config.settings import Config, config_from_values
from quadtree_lss.onboard.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.errors import QuadtreeLssError
from quadtree_lss.onboard.messages.clouds import stamp_ns
from quadtree_lss.onboard.messages.intake import noise_notice

if TYPE_CHECKING:
    from quadtree_lss.desk.replay.info import BagInfo, TopicInfo

MOST_CONTRADICTING, LEAST_MAPPED = 0.05, 0.95
"""Most points that contradict the map and least scans that are mapped in a sound bag, as shares."""
BETTER = 0.8
"""A fix leaves at most this share of the contradicting points, the leaves or their roughness."""
FITTED = ("domain.", "lidar.range_noise", "lss.grid_spacing")
"""Suggested values for a trial if the domain is the default one."""
UNREADABLE = {"times_unreasonable", "times_unknown"}
"""Notices of point times that are not used."""


class Trial(NamedTuple):
    """A bag that was mapped with ``config`` and ``lag_s`` added to the clouds' stamps: ``reports``
    on the scans, mean ``roughness`` of the map, m, and ``gap`` between scans and map beyond what
    the poses claim, m. ``failure``: why there is no suggestion."""

    config: Config
    lag_s: float
    recording: Recording
    tf_mounts: Mapping[str, Pose]
    reports: list[ScanReport]
    roughness: float
    gap: float | None
    suggestion: Suggestion | None
    failure: str

    @property
    def used(self) -> int:
        return sum(report.points_used for report in self.reports)

    @property
    def share(self) -> float:
        """Share of the usable points that contradict the map."""
        lost = sum(report.dropped.get("contradiction", 0) for report in self.reports)
        return lost / max(self.used + lost, 1)

    @property
    def text(self) -> str:
        share = f"{100 * self.share:.1f} % of the points contradict the map"
        return share if self.used else "no point enters the map"

    @property
    def apart(self) -> float | None:
        """How far scans disagree, m; None if they agree."""
        heights = [abs(r.offset) for r in self.reports if r.dropped.get("contradiction")]
        found = [np.median(heights)] if self.share > MOST_CONTRADICTING else []
        return float(max(found + [self.gap or 0.0])) if found or self.gap else None

    def improves_on(self, other: Trial) -> bool:
        """Whether scans agree clearly better, or the map is clearly simpler or smoother."""
        if not self.used or self.share > other.share + 0.01:
            return False
        if not other.used or self.share < BETTER * other.share - 0.01:
            return True
        fewer = self.reports[-1].leaves < BETTER * other.reports[-1].leaves
        return fewer or self.roughness < BETTER * other.roughness


def try_config(
    bag: str | Path | Bag, asked: Config, how: Mapping[str, Any], lag_s: float = 0.0
) -> Trial:
    """Map a bag with a configuration; if its domain is the default one, with what is suggested.
    ``how``: topics and poses as of `replay.replay`. ``lag_s``: time to add to the clouds' stamps.
    """
    config, suggestion, failure = asked, None, "no return lies in the lidar's range"
    try:
        suggestion = suggest_config(bag, asked, **how)
        if asked.domain == Config().domain:
            values = suggestion.values.items()
            config = config_from_values({k: v for k, v in values if k.startswith(FITTED)}, asked)
    except QuadtreeLssError as error:
        failure = str(error)
    mapper, reports = Mapper(config), []
    with open_recording(bag, how["poses"], config.frames.map) as opened:
        stream = Stream(opened, config, how["scan_topic"], how["pose_topic"])
        recording = Recording(next(t.count for t in opened.topics if t.name == stream.scans))

        def hear(kind: str, msg: Any, _: RawMessage) -> None:
            if lag_s and kind in ("pose", "gimbal"):
                stamp = msg.header.stamp
                ns = stamp_ns(msg.header) - round(lag_s * SECOND_NS)
                stamp.sec, stamp.nanosec = divmod(ns, SECOND_NS)
            if kind == "pose":
                recording.add_pose(msg)

        stream.hear = hear
        for scan in stream.ready(Part.of(opened)):
            recording.add_scan(scan)
            reports.append(mapper.update(scan.points_lidar, scan.pose, scan.sweep))
    cells = mapper.snapshot()
    rough = float(np.nanmean(cells.roughness[cells.measured])) if cells.measured.any() else 0.0
    gap = (mapper.pose_gap() or [None])[0]
    found = recording, stream.tf_mounts, reports, rough, gap, suggestion, failure
    return Trial(config, lag_s, *found)


def diagnose(
    info: BagInfo, bag: Bag, asked: Config, texts: Mapping[str, str], how: Mapping[str, Any]
) -> None:
    """Add to ``info`` the faults that mapping an open bag confirms, what to suggest with their
    settings, and the verdict. ``texts``: the intake's notices. ``how``: as of `try_config`."""
    source: str | Bag = info.path if Path(info.path).exists() else bag
    scans = next(topic for topic in info.topics if topic.name == info.scan_topic)
    period = math.nan if UNREADABLE & texts.keys() else 1.0 / scans.rate
    first = best = try_config(source, asked, how)
    fixed = True
    while fixed:
        found, fixed = _find(best, asked, period, NO_POSES in bag.notes), False
        for fault in (fault for fault in found if fault.settings or fault.lag_s):
            changed = config_from_values(fault.settings or {}, asked)
            trial = try_config(source, changed, how, best.lag_s + fault.lag_s)
            if trial.improves_on(best):
                best, asked, fixed = trial, changed, True
                text = f"{fault.text}; with the fix {trial.text}"
                info.findings.append(fault._replace(text=text))
                break
    info.findings += [fault for fault in found if not (fault.settings or fault.lag_s)]
    info.suggestion = _match_noise(source, best, asked, how).suggestion
    _conclude(info, first, best, texts, scans)


def _match_noise(
    bag: str | Path | Bag, best: Trial, asked: Config, how: Mapping[str, Any]
) -> Trial:
    """Try the range noise that the map shows if it is not the suggested one: ground that is rough
    within a cell adds to it. Return the trial that a replay does not warn of, else the best."""
    ratio = best.reports[-1].noise_ratio if best.reports else math.nan
    noise = float(f"{ratio * best.config.lidar.range_noise:.2g}")
    cell = best.config.domain.size / 2**best.config.domain.max_level
    if noise_notice(ratio, best.config) is None or not NOISES * noise < cell:
        return best
    changed = config_from_values({"lidar.range_noise": noise}, asked)
    trial = try_config(bag, changed, how, best.lag_s)
    matched = trial.reports and noise_notice(trial.reports[-1].noise_ratio, trial.config) is None
    return trial if matched else best


def _find(trial: Trial, asked: Config, period: float, made_up: bool) -> list[Finding]:
    """Find faults in a bag that was mapped. ``made_up``: there are no recorded poses."""
    found, lidar, recording = [], trial.config.lidar, trial.recording
    most = trial.suggestion.values.get("lidar.max_range") if trial.suggestion else None
    if most is not None and most < lidar.max_range:
        text = "many returns are at one greatest range: rays without a return"
        found.append(make_setting("max_range", text, {"lidar.max_range": most}))
        lidar = replace(lidar, max_range=most)
    if made_up:
        return found
    # Faults of frames make the noise appear larger.
    lidar = replace(lidar, range_noise=min(lidar.range_noise, asked.lidar.range_noise))
    found += find_pose_faults(recording.poses)
    if (flight := recording.flight(lidar)) is not None:
        config, period = replace(trial.config, lidar=lidar), 0.0 if recording.has_times else period
        found += find_faults(flight, config, trial.tf_mounts, period)
    return found


def _conclude(
    info: BagInfo, first: Trial, best: Trial, texts: Mapping[str, str], scans: TopicInfo
) -> None:
    """Set the verdict on the bag as it is and with the fixes."""
    total, mapped = info.scans_with_pose + sum(info.scans_dropped.values()), len(first.reports)
    apart = first.apart
    for k, finding in enumerate(info.findings):
        if finding.key == "outside" and any(f.fix for f in info.findings if f.key != "outside"):
            info.findings[k] = finding._replace(fix="")  # a consequence
        frames = finding.key == "frames" and finding.text.startswith(info.scan_topic)
        if apart is not None and frames:
            fix = "send the clouds of each lidar on a topic of its own"
            info.findings[k] = finding._replace(fix=fix)
    faults = sum(bool(finding.fix) for finding in info.findings) or len(info.problems)
    above = f"see the {f'{faults} faults' if faults > 1 else 'fault'} above"
    figures = f"{mapped} of {total} scans mapped, {first.text}"
    figures += f"; with the fixes {best.text}" if best is not first else ""
    key = ""
    if not first.used and info.scans_with_pose:
        key, info.verdict = (
            "dropped",
            f"no scan can be mapped: {above if faults else first.failure}",
        )
    elif mapped < LEAST_MAPPED * total:
        reason = max(info.scans_dropped, key=info.scans_dropped.__getitem__, default="")
        why = texts.get(reason, reason)
        if reason == "duplicate":
            one, at = scans.first_stamp_ns == scans.last_stamp_ns, (scans.first_stamp_ns or 0) / 1e9
            why = f"all carry the stamp {at:.3f} s" if one else "their stamps occur before"
            why += ": check the driver's timestamp mode, and for a second publisher"
        key, info.verdict = "dropped", f"{total - mapped} of {total} scans dropped: {why}"
    elif apart is not None:
        key, why = "disagree", f": {above}" if faults else "; no common fault explains it"
        info.verdict = f"scans disagree by {apart:.2g} m{why} ({figures})"
    elif faults:
        info.verdict = f"{above}; as it is, {figures}"
    else:
        info.verdict = f"nothing is wrong with {info.scan_topic} and {info.pose_topic}: {figures}"
    if key:
        info.findings.append(Finding(key, info.verdict, fatal=True))
