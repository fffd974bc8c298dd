# SPDX-License-Identifier: Apache-2.0
"""A bag mapped as it is and with each setting that may fix it: what `doctor` says in the end."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from quadtree_lss.desk.bags.bag import Bag
from quadtree_lss.desk.bags.cloud_files import NO_POSES
from quadtree_lss.desk.replay.doctor import findings
from quadtree_lss.desk.replay.heard import Finding, Heard, setting
from quadtree_lss.desk.replay.replay import steps
from quadtree_lss.desk.replay.stream import Stream
from quadtree_lss.desk.replay.suggest import Seen, suggest_config
from quadtree_lss.onboard.config.settings import Config, config_from_values
from quadtree_lss.onboard.errors import QuadtreeLssError

if TYPE_CHECKING:
    from quadtree_lss.desk.replay.info import BagInfo

MOST_CONTRADICTING, LEAST_MAPPED = 0.05, 0.95
"""Shares, of the points that the map could use and of the scans, of a bag with which nothing is
wrong."""
BETTER = 0.8
"""A setting is kept if with it this share of what contradicts, of the leaves or of their roughness
is left."""
FITTED = ("domain.xmin", "domain.ymin", "domain.size", "domain.min_level", "domain.max_level")
"""Settings suggested for a trial if the domain is the default one, with the range noise."""


class Trial(NamedTuple):
    """A bag mapped. ``scans``: that were. ``used``, ``contradicting``: points. ``apart``: median of
    the heights by which rejected scans lie over the map, m. ``leaves``, ``roughness``: in the end,
    their count, and the mean distance of their returns from their planes, m."""

    scans: int = 0
    used: int = 0
    contradicting: int = 0
    apart: float = 0.0
    leaves: int = 0
    roughness: float = 0.0

    @property
    def share(self) -> float:
        """Share of the usable points that contradict the map."""
        return self.contradicting / all_ if (all_ := self.used + self.contradicting) else 0.0

    def improves_on(self, other: Trial) -> bool:
        """Whether scans agree clearly better, or the ground becomes clearly simpler or smoother."""
        if not self.used or self.share > other.share + 0.01:
            return False
        fewer = self.leaves < BETTER * other.leaves or self.roughness < BETTER * other.roughness
        return not other.used or self.share < BETTER * other.share - 0.01 or fewer


def mapped(bag: str | Path | Bag, config: Config, how: Mapping[str, Any]) -> Trial:
    """Maps a bag. ``how``: topics and poses, as of `replay.replay`."""
    scans = used = contradicting = leaves = 0
    apart, step = [], None
    for step in steps(bag, config, **how):
        report = step.report
        scans, leaves = scans + 1, report.leaves
        used += report.points_used
        if against := report.dropped.get("contradiction", 0):
            contradicting += against
            apart.append(abs(report.offset))
    rough = 0.0
    if step is not None and used:
        cells = step.mapper.snapshot()
        rough = float(np.nanmean(cells.roughness[cells.measured]))
    return Trial(scans, used, contradicting, float(np.median(apart or [0.0])), leaves, rough)


def fitted(config: Config, values: Mapping[str, Any]) -> Config:
    """The configuration with the domain and range noise that are suggested, where it has the
    default ones."""
    usual = Config()
    names = FITTED if config.domain == usual.domain else ()
    if config.lidar.range_noise == usual.lidar.range_noise:
        names = (*names, "lidar.range_noise")
    return config_from_values({name: values[name] for name in names}, config)


def diagnosed(
    info: BagInfo,
    bag: Bag,
    stream: Stream,
    heard: Heard,
    seen: Seen,
    texts: Mapping[str, str],
    how: Mapping[str, Any],
) -> None:
    """Adds to ``info`` what the ground of an open bag says, as far as mapping it confirms that, and
    the verdict. ``texts``: of the intake's notices. ``how``: as of `mapped`."""
    source: str | Bag = info.path if Path(info.path).exists() else bag
    config, best, failure = stream.config, Trial(), "no return lies in the lidar's range"
    found_by_range = []
    try:
        if seen.places:
            values = seen.suggestion(bag.path, {}, ()).values
            config = fitted(config, values)
            if most := values.get("lidar.max_range"):
                text = "many returns are at one greatest range: rays without a return"
                found_by_range = [setting("max_range", text, {"lidar.max_range": most})]
            best = mapped(source, config, how)
            # Faults of frames make the noise look larger than it is.
            noise = min(config.lidar.range_noise, stream.config.lidar.range_noise)
            judged = {"lidar.range_noise": noise} | ({"lidar.max_range": most} if most else {})
            config = config_from_values(judged, config)
    except QuadtreeLssError as error:
        failure = str(error)
    trial, asked = best, stream.config
    timed = not {"times_unreasonable", "times_unknown"} & texts.keys()
    by_ground = [] if NO_POSES in bag.notes else findings(heard, config, timed=timed)
    claimed = [*found_by_range, *by_ground]
    info.findings += [finding for finding in claimed if finding.settings is None]
    pending = [finding for finding in claimed if finding.settings is not None]
    kept = True
    while kept and pending:  # one fault may hide what another costs
        kept = False
        for finding in tuple(pending):
            changed = config_from_values(finding.settings or {}, asked)
            try:
                values = suggest_config(source, changed, **how).values
                found = mapped(source, fitted(changed, values), how)
            except QuadtreeLssError:
                continue
            if found.improves_on(best):
                best, asked, kept = found, changed, True
                pending.remove(finding)
                text = f"{finding.text}; with it {_contradicting(found)}"
                info.findings.append(finding._replace(text=text))
    _judge(info, trial, failure, texts)


def _contradicting(trial: Trial) -> str:
    if not trial.used:
        return "no point enters the map"
    return f"{100 * trial.share:.1f} % of the points contradict the map"


def _judge(info: BagInfo, trial: Trial, failure: str, texts: Mapping[str, str]) -> None:
    """Sets the verdict; where it is no good one it is a finding, too. ``failure``: why no scan was
    mapped although some have a pose. ``texts``: of the intake's notices."""
    total = info.scans_with_pose + sum(info.scans_dropped.values())
    disagree = trial.share > MOST_CONTRADICTING
    others = any(finding.mend for finding in info.findings if finding.key != "outside")
    for k, finding in enumerate(info.findings):
        if others and finding.key == "outside":  # as a consequence
            info.findings[k] = finding._replace(mend="")
        if disagree and finding.key == "frames" and finding.text.startswith(info.scan_topic):
            mend = "send the clouds of each lidar on a topic of its own"
            info.findings[k] = finding._replace(mend=mend)
    count = sum(bool(finding.mend) or finding.fatal for finding in info.findings)
    figures = f"{trial.scans} of {total} scans mapped, {_contradicting(trial)}"
    why = "; no common fault explains it" if not count else ": see above"
    if not trial.used and info.scans_with_pose:
        info.verdict = f"no scan can be mapped: {'see above' if count else failure}"
        info.findings += [] if count else [Finding("dropped", info.verdict, fatal=True)]
    elif trial.scans < LEAST_MAPPED * total:
        reason = max(info.scans_dropped, key=info.scans_dropped.__getitem__, default="")
        scans = next(topic for topic in info.topics if topic.name == info.scan_topic)
        if reason == "duplicate":
            one = scans.first_stamp_ns == scans.last_stamp_ns
            reason = "one stamp" if one else "stamps that a scan before them has"
            reason += ": check the driver's timestamp mode, and for a second publisher"
        info.verdict = (
            f"{total - trial.scans} of {total} scans dropped: {texts.get(reason, reason)}"
        )
        info.findings.append(Finding("dropped", info.verdict, fatal=True))
    elif disagree:
        info.verdict = f"scans disagree by {trial.apart:.2g} m{why} ({figures})"
        info.findings.append(Finding("disagree", info.verdict, fatal=True))
    elif count:
        info.verdict = f"{count} fault{'s' * (count > 1)}, see above; as it is, {figures}"
    else:
        read = f"{info.scan_topic} and {info.pose_topic}"
        info.verdict = f"nothing is wrong with {read}: {figures}"
