# SPDX-License-Identifier: Apache-2.0
"""Diagnosis of a bag: map it as it is and with each fix, and conclude with a verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from quadtree_lss.desk.bags.bag import Bag, open_bag
from quadtree_lss.desk.replay.faults import Finding, find_faults, find_pose_faults, make_setting
from quadtree_lss.desk.replay.reading import UNREADABLE_TIMES, Reading
from quadtree_lss.desk.replay.stream import Progress, Stream
from quadtree_lss.desk.replay.suggest import NOISES, Suggestion, suggest_config
from quadtree_lss.onboard.config.settings import Config, DomainConfig, config_from_values
from quadtree_lss.onboard.errors import QuadtreeLssError
from quadtree_lss.onboard.messages.intake import noise_notice

if TYPE_CHECKING:
    from quadtree_lss.desk.replay.info import BagInfo

MOST_CONTRADICTING, LEAST_MAPPED = 0.05, 0.95
"""Most points that contradict the map and least scans that are mapped in a sound bag, as shares."""
BETTER = 0.8
"""A fix leaves at most this share of the contradicting points, the leaves or their roughness."""
DISAGREEING = {
    "frames": "send the clouds of each lidar on a topic of its own",
    "jump": "take poses without jumps, or replay the parts between them (--start, --duration)",
}
"""Fixes of findings that are faults if scans disagree, by their key."""
FITTED = ("domain.", "lidar.range_noise", "lss.grid_spacing")
"""Suggested values for a trial if the domain is the default one."""


class Trial(Reading):
    """A bag that was mapped with ``config``; ``suggestion``: for this bag and these settings, or
    None because of ``failure``."""

    suggestion: Suggestion | None = None
    failure = ""

    @property
    def used(self) -> int:
        return sum(report.points_used for report in self.reports)

    @property
    def share(self) -> float:
        """Share of the usable points that contradict the map."""
        lost = self.dropped["contradiction"]
        return lost / max(self.used + lost, 1)

    @property
    def text(self) -> str:
        share = f"{100 * self.share:.1f} % of the points contradict the map"
        return share if self.used else "no point enters the map"

    @property
    def apart(self) -> float | None:
        """How far scans disagree, m; None if they agree."""
        heights = [abs(r.offset) for r in self.reports if r.dropped.get("contradiction")]
        median = float(np.median(heights)) if self.share > MOST_CONTRADICTING else 0.0
        return max(median, self.gap or 0.0) or None

    def improves_on(self, other: Trial) -> bool:
        """Whether scans agree clearly better, or the map is clearly simpler or smoother."""
        if not self.used or self.share > other.share + 0.01:
            return False
        if not other.used or self.share < BETTER * other.share - 0.01:
            return True
        fewer = self.reports[-1].leaves < BETTER * other.reports[-1].leaves
        return fewer or self.roughness < BETTER * other.roughness


def try_config(
    bag: str | Path | Bag,
    asked: Config,
    how: Mapping[str, Any],
    lag_s: float = 0.0,
    progress: Progress | None = None,
) -> Trial:
    """Map a bag with a configuration; if its domain is the default one, with what is suggested.
    ``how``: topics as of `replay.replay`. ``lag_s``: time to add to the clouds' stamps.
    """
    config, suggestion, failure = asked, None, "no return lies in the lidar's range"
    try:
        suggestion = suggest_config(bag, asked, **how)
        if asked.domain == Config().domain:
            values = suggestion.values.items()
            config = config_from_values({k: v for k, v in values if k.startswith(FITTED)}, asked)
    except QuadtreeLssError as error:
        failure = str(error)
    with open_bag(bag) as opened:
        stream = Stream(opened, config, **how, adapt=True)
        trial = Trial(opened, stream, lag_s, progress)
    trial.suggestion, trial.failure = suggestion, failure
    return trial


def diagnose(
    info: BagInfo, bag: Bag, asked: Config, how: Mapping[str, Any], progress: Progress | None
) -> None:
    """Add to ``info`` the faults that mapping an open bag confirms, what to suggest with their
    settings, and the verdict. ``how``: as of `try_config`."""
    source: str | Bag = info.path if Path(info.path).exists() else bag
    first = try_config(source, asked, how, progress=progress)
    info.add(first)
    before = best = _State(first, asked, _find(first, asked))
    fixes: list[Finding] = []
    while fixed := _fix(source, best, how):
        fault, best = fixed
        fixes.append(fault)
    if first.used and best.trial.apart is not None:  # the fixes do not explain it
        best, fixes = before, []
    info.findings += fixes
    info.findings += [fault for fault in best.found if not (fault.settings or fault.lag_s)]
    info.suggestion = _match_noise(source, best.trial, best.asked, how).suggestion
    _conclude(info, first, best.trial, asked.domain)


class _State(NamedTuple):
    """A trial, the configuration that was asked for, and the faults that are still there."""

    trial: Trial
    asked: Config
    found: list[Finding]


def _fix(
    bag: str | Path | Bag, state: _State, how: Mapping[str, Any]
) -> tuple[Finding, _State] | None:
    """Return the first fault of which the fix improves the map, and the state with it."""
    for fault in (fault for fault in state.found if fault.settings or fault.lag_s):
        asked = config_from_values(fault.settings or {}, state.asked)
        trial = try_config(bag, asked, how, state.trial.lag_s + fault.lag_s)
        if trial.improves_on(state.trial):
            told = fault._replace(text=f"{fault.text}; with the fix {trial.text}")
            return told, _State(trial, asked, _find(trial, asked))
    return None


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


def _find(trial: Trial, asked: Config) -> list[Finding]:
    """Find faults in a bag that was mapped."""
    found, lidar, recording = [], trial.config.lidar, trial.recording
    most = trial.suggestion.values.get("lidar.max_range") if trial.suggestion else None
    if most is not None and most < lidar.max_range:
        text = "many returns are at one greatest range: rays without a return"
        found.append(make_setting("max_range", text, {"lidar.max_range": most}))
        lidar = replace(lidar, max_range=most)
    # Faults of frames make the noise appear larger.
    lidar = replace(lidar, range_noise=min(lidar.range_noise, asked.lidar.range_noise))
    found += find_pose_faults(recording.poses)
    if (flight := recording.flight(lidar)) is not None:
        period = 1.0 / trial.scan_rate
        if recording.has_times or UNREADABLE_TIMES & trial.notices.keys():
            period = 0.0 if recording.has_times else math.nan
        config, mounts = replace(trial.config, lidar=lidar), trial.stream.tf_mounts
        found += find_faults(flight, config, mounts, period)
    return found


def _conclude(info: BagInfo, first: Trial, best: Trial, domain: DomainConfig) -> None:
    """Set the verdict on the bag as it is and with the fixes. ``domain``: as it was asked for."""
    mapped, apart = len(first.reports), first.apart
    total = mapped + sum(info.scans_dropped.values()) - first.repeats
    found = info.findings
    if apart is not None:
        found = [f._replace(fix=DISAGREEING.get(f.key, f.fix)) for f in found]
        found = [f for f in found if f.key not in ("calm", "tilt")]
    if any(f.fix and f.key != "outside" for f in found):  # which explains it
        found = [f._replace(fix=f.fix * (f.key != "outside")) for f in found]
    info.findings = found
    faults = sum(bool(finding.fix) for finding in info.findings) or len(info.problems)
    above = f"see the {f'{faults} faults' if faults > 1 else 'fault'} above"
    figures = f"{mapped} of {total} scans mapped, {first.text}"
    figures += f"; with the fixes {best.text}" if best is not first else ""
    figures += ", in the domain that `config suggest` writes" * (first.config.domain != domain)
    key = ""
    if mapped and not first.used:
        why = above if faults else first.failure
        key, info.verdict = "dropped", f"no scan can be mapped: {why}"
    elif mapped < LEAST_MAPPED * total:
        why = first.why_same_stamp() or (above if faults else first.why_dropped())
        key, info.verdict = "dropped", f"{total - mapped} of {total} scans dropped: {why}"
    elif apart is not None:
        key, why = "disagree", f": {above}" if faults else "; no common fault explains it"
        info.verdict = f"scans disagree by {apart:.2g} m{why} ({figures})"
    elif faults:
        info.verdict = f"{above}; as it is, {figures}"
    else:
        info.verdict = f"nothing is wrong with {info.scan_topic} and {info.pose_topic}: {figures}"
        if slope := next((f for f in info.findings if f.key == "tilt"), None):
            info.verdict = f"{slope.text.partition(';')[0]}: if it really does, {info.verdict}"
    if key:
        info.findings.append(Finding(key, info.verdict, fatal=True))
