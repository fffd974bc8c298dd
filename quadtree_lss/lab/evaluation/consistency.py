# SPDX-License-Identifier: Apache-2.0
"""Consistency of a map over a whole bag (Table 2): are its covariances what they say?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import quadtree_lss
from quadtree_lss.desk.replay.replay import scans
from quadtree_lss.lab.evaluation.prefit import Counts, prefit_statistics
from quadtree_lss.lab.evaluation.results import COLUMNS, EvaluationError, Results, aligned
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.mapping.mapper import Mapper, ScanReport
from quadtree_lss.onboard.core.sensing.register import register


@dataclass(frozen=True)
class Consistency:
    """Prefit residuals of a bag. ``counts``: residuals outside the 95 % intervals. ``scans``: scans
    that were mapped; the first has nothing to be compared with."""

    counts: Counts
    scans: int

    def table(self) -> str:
        rows = [("Prefit residuals", "below", "above", "both")]
        for name, of in (
            ("one degree of freedom", self.counts.one_degree),
            ("three (the paper)", self.counts.three_degrees),
        ):
            rows.append((name, *(f"{share:.2%}" for share in (*of, of.below + of.above))))
        return "\n".join(aligned(rows))


def consistency(
    bag: str | Path,
    config: Config,
    *,
    results: Results | None = None,
    scan_topic: str | None = None,
    pose_topic: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> Consistency:
    """Map a bag as ``replay`` would; before each scan compare its points with the map as it is.

    With ``results``, only the scans that were mapped into these, which must be the same.
    ``progress`` is called with the number of scans mapped so far.

    Raises:
        BagError: the bag cannot be read or its topics are ambiguous.
        EvaluationError: no point of it fell on ground that was already mapped, or the scans are
            not those of the results.
    """
    rows: dict[int, list[int]] = {}
    if results is not None:
        columns = [results.timing[name].tolist() for name in COLUMNS[:4]]
        rows = {stamp: row for stamp, *row in zip(*columns, strict=True)}
    made_by = {} if results is None else results.summary.get("versions") or {}
    exact = made_by.get("quadtree_lss") == quadtree_lss.__version__
    counts, number, mapper = Counts(), 0, Mapper(config)
    for scan in scans(bag, config, scan_topic=scan_topic, pose_topic=pose_topic):
        if rows and scan.stamp_ns not in rows:
            continue
        registered, _ = register(*scan[1:3], config.lidar, mapper.domain, scan.sweep)
        counts += prefit_statistics(mapper.snapshot(), registered, config.lidar).counts()
        report = mapper.update(scan.points_lidar, scan.pose, scan.sweep)
        if rows:
            _check(report, rows[report.stamp_ns], exact, bag)
        number += 1
        if progress is not None:
            progress(number)
    if number < len(rows):
        msg = f"{bag} lacks {len(rows) - number} of the {len(rows)} scans that were mapped"
        raise EvaluationError(msg)
    if not counts.points:
        msg = f"{bag}: no point of {number} scans fell on ground that was already mapped"
        raise EvaluationError(msg)
    return Consistency(counts, number)


def _check(report: ScanReport, row: list[int], exact: bool, bag: str | Path) -> None:
    """Compare a scan, and the map after it, with its row of ``timing.csv``.

    Results of another version can only be asked for the points (not ``exact``). Of another
    processor leaves may differ by the few whose statistics lie on a threshold to the last bit.
    """
    points, used, leaves = row
    near = abs(report.leaves - leaves) <= 2 + leaves // 100
    if report.points == points and (not exact or (report.points_used == used and near)):
        return
    raise EvaluationError(
        f"{bag} holds other scans than were mapped: after that of {report.stamp_ns} ns"
        f" {report.points_used} of {report.points} points are used and there are"
        f" {report.leaves} leaves, by timing.csv {used} of {points} and {leaves}"
    )
