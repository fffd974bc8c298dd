# SPDX-License-Identifier: Apache-2.0
"""Consistency of a map over a whole bag (Table 2): are its covariances what they say?"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from quadtree_lss.core.config import Config
from quadtree_lss.core.consistency import Counts, prefit_statistics
from quadtree_lss.core.mapping import Mapper
from quadtree_lss.core.scan import register
from quadtree_lss.evaluation.results import EvaluationError
from quadtree_lss.replay.stream import scans


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
    counts, number = Counts(), 0
    mapper = Mapper(config)
    for scan in scans(bag, config, scan_topic=scan_topic, pose_topic=pose_topic):
        registered, _ = register(scan.points_lidar, scan.pose, config.lidar, mapper.domain)
        statistics = prefit_statistics(mapper.leaves, registered, config.lidar.range_noise)
        counts += statistics.counts()
        mapper.update(scan.points_lidar, scan.pose)
        number += 1
        if progress is not None:
            progress(number)
    if not counts.points:
        msg = f"{bag}: no point of {number} scans fell on ground that was already mapped"
        raise EvaluationError(msg)
    return Consistency(counts, number)
