# SPDX-License-Identifier: Apache-2.0
"""Consistency of a map over a whole bag (Table 2): are its covariances what they say?"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from quadtree_lss.core.config import Config
from quadtree_lss.core.consistency import Counts, prefit_statistics
from quadtree_lss.core.mapping import Mapper
from quadtree_lss.core.scan import register
from quadtree_lss.evaluation.results import EvaluationError
from quadtree_lss.messages.clouds import MessageError
from quadtree_lss.messages.intake import Intake, ReadyScan
from quadtree_lss.replay.bags import POSE_TOPIC, SCAN_TOPIC, Bag, choose_topic
from quadtree_lss.replay.types import POSE_TYPE, SCAN_TYPE


@dataclass(frozen=True)
class Consistency:
    """Prefit residuals of one bag or of several together.

    Attributes:
        counts: Residuals outside the 95 % intervals.
        scans: Scans that were mapped; the first has nothing to be compared with.
    """

    counts: Counts
    scans: int

    def table(self) -> str:
        """Both tests in aligned lines, like Table 2."""
        lines = [f"{'Prefit residuals':<24}{'below':>9}{'above':>9}{'both':>9}"]
        for name, of in (
            ("one degree of freedom", self.counts.one_degree),
            ("three (the paper)", self.counts.three_degrees),
        ):
            both = of.below + of.above
            lines.append(f"{name:<24}{of.below:>9.2%}{of.above:>9.2%}{both:>9.2%}")
        return "\n".join(lines)


def pool(parts: Iterable[Consistency]) -> Consistency:
    """Several bags, every residual with the same weight."""
    counts, scans = Counts(), 0
    for part in parts:
        counts, scans = counts + part.counts, scans + part.scans
    return Consistency(counts, scans)


def consistency(
    bag: str | Path,
    config: Config,
    *,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> Consistency:
    """Map a bag; before each scan compare its points with the map as it is.

    Args:
        bag: A bag as of `Bag`.
        config: As for ``replay``.
        scan_topic, pose_topic: By default found by name, then by type.
        progress: Called with the number of scans mapped so far.

    Raises:
        BagError: the bag cannot be read or its topics are ambiguous.
        EvaluationError: no point of it fell on ground that was already mapped.
    """
    counts, scans = Counts(), 0
    mapper = Mapper(config)
    for scan in scans_of(bag, config, scan_topic, pose_topic):
        registered, _ = register(scan.points_lidar, scan.pose, config.lidar, mapper.domain)
        statistics = prefit_statistics(mapper.leaves, registered, config.lidar.range_noise)
        counts += statistics.counts()
        mapper.update(scan.points_lidar, scan.pose)
        scans += 1
        if progress is not None:
            progress(scans)
    if not counts.points:
        msg = f"{bag}: no point of {scans} scans fell on ground that was already mapped"
        raise EvaluationError(msg)
    return Consistency(counts, scans)


def scans_of(
    bag: str | Path, config: Config, scan_topic: str | None = None, pose_topic: str | None = None
) -> Iterator[ReadyScan]:
    """Scans of a bag with their poses, in the order in which a node would map them.

    Messages that cannot be used are left out, as in a node.
    """
    with Bag(bag) as opened:
        scans = choose_topic(opened, scan_topic, SCAN_TOPIC, SCAN_TYPE, "--scan-topic")
        poses = choose_topic(opened, pose_topic, POSE_TOPIC, POSE_TYPE, "--pose-topic")
        intake = Intake(config, scan_topic=scans, pose_topic=poses)
        for message in opened.messages((scans, poses), opened.start_ns, opened.end_ns + 1):
            is_scan = message.topic == scans
            try:
                msg = opened.decode(message.raw, SCAN_TYPE if is_scan else POSE_TYPE)
            except MessageError as error:
                intake.reject("cloud" if is_scan else "pose", error)
                continue
            if is_scan:
                intake.on_cloud(msg, message.received_ns)
            else:
                intake.on_pose(msg)
            yield from intake.ready(message.received_ns)
