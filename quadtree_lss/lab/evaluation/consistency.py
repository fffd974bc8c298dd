# SPDX-License-Identifier: Apache-2.0
"""Consistency of a map over a whole bag (Table 2): are its covariances what they say?"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import quadtree_lss
from quadtree_lss.desk.replay.scans import scans
from quadtree_lss.lab.evaluation.results import EvaluationError, Results
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.mapping.consistency import Counts, prefit_statistics
from quadtree_lss.onboard.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.onboard.core.sensing.register import register


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
    results: Results | None = None,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> Consistency:
    """Map a bag; before each scan compare its points with the map as it is.

    Args:
        bag: A bag as of `Bag`.
        config: As for ``replay``.
        results: Map only the scans that were mapped into these, and make sure that they are the
            same.
        scan_topic, pose_topic: By default found by name, then by type.
        progress: Called with the number of scans mapped so far.

    Raises:
        BagError: the bag cannot be read or its topics are ambiguous.
        EvaluationError: no point of it fell on ground that was already mapped, or the scans are
            not those of the results.
    """
    counts, number = Counts(), 0
    wanted = _Wanted(results)
    mapper = Mapper(config)
    for scan in scans(bag, config, scan_topic=scan_topic, pose_topic=pose_topic):
        if scan.stamp_ns not in wanted:
            continue
        registered, _ = register(*scan[1:3], config.lidar, mapper.domain, scan.sweep)
        statistics = prefit_statistics(mapper.snapshot(), registered, config.lidar)
        counts += statistics.counts()
        wanted.check(mapper.update(scan.points_lidar, scan.pose, scan.sweep), bag)
        number += 1
        if progress is not None:
            progress(number)
    wanted.check_all(number, bag)
    if not counts.points:
        msg = f"{bag}: no point of {number} scans fell on ground that was already mapped"
        raise EvaluationError(msg)
    return Consistency(counts, number)


class _Wanted:
    """The scans of some results by their stamp, or any scan without results of scans."""

    def __init__(self, results: Results | None) -> None:
        self._rows: dict[int, list[int]] = {}
        self._exact = False
        if results is not None:
            rows = zip(results.stamps_ns.tolist(), results.counts.tolist(), strict=True)
            self._rows = dict(rows)
            made_by = results.summary.get("versions") or {}
            self._exact = made_by.get("quadtree_lss") == quadtree_lss.__version__

    def __contains__(self, stamp_ns: int) -> bool:
        return not self._rows or stamp_ns in self._rows

    def check(self, report: ScanReport, bag: str | Path) -> None:
        """Compare a scan, and the map after it, with its row of ``timing.csv``."""
        if not self._rows:
            return
        points, used, leaves = self._rows[report.stamp_ns]
        same = report.points == points
        if self._exact:
            # Of another version nothing more can be asked. Of another processor leaves may
            # differ by the few whose statistics lie on a threshold to the last bit.
            near = abs(report.leaves - leaves) <= 2 + leaves // 100
            same = same and report.points_used == used and near
        if not same:
            msg = (
                f"{bag} holds other scans than were mapped: after that of {report.stamp_ns} ns"
                f" {report.points_used} of {report.points} points are used and there are"
                f" {report.leaves} leaves, by timing.csv {used} of {points} and {leaves}"
            )
            raise EvaluationError(msg)

    def check_all(self, mapped: int, bag: str | Path) -> None:
        """Compare the number of scans."""
        if mapped < len(self._rows):
            missing = len(self._rows) - mapped
            msg = f"{bag} lacks {missing} of the {len(self._rows)} scans that were mapped"
            raise EvaluationError(msg)
