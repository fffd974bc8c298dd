# SPDX-License-Identifier: Apache-2.0
"""Scores of one run against the truth: elevation, hazard detection (Table 3), sites, risk."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from quadtree_lss.desk.replay.files import plain
from quadtree_lss.desk.replay.results import aligned
from quadtree_lss.lab.evaluation import metrics
from quadtree_lss.lab.evaluation.results import TOP, EvaluationError, Results, Truth


@dataclass(frozen=True)
class EvaluationResult:
    """Scores of one run.

    Attributes:
        site_verdicts: Verdicts on the first five sites.
        risk: None without risks.
        notes: Parts that could not be checked.
        safety: The compared grid points.
        out: Folder of the files.
    """

    elevation: metrics.ElevationError
    detection: metrics.Detection
    sites: int
    site_verdicts: tuple[metrics.SiteVerdict, ...]
    risk: metrics.Reliability | None
    leaves: int
    leaves_estimated: int
    safety: metrics.SafetyField
    out: Path = Path()
    notes: tuple[str, ...] = ()

    @property
    def unsafe_in_top_five(self) -> int:
        return self.site_verdicts.count("unsafe")

    def as_dict(self) -> dict[str, Any]:
        omitted = ("safety", "out")
        kept = {key: plain(value) for key, value in asdict(self).items() if key not in omitted}
        return {**kept, "unsafe_in_top_five": self.unsafe_in_top_five}

    def table(self) -> str:
        e, d = self.elevation, self.detection
        rows = [
            ("Elevation error, mean absolute", _show(e.mean_absolute, ".3f", " m")),
            ("  RMS / largest", f"{_show(e.rms, '.3f')} / {_show(e.maximum, '.2f', ' m')}"),
            ("  mean", _show(e.mean, "+.3f", " m")),
            ("  RMS with the mean removed", _show(e.rms_mean_removed, ".3f", " m")),
            ("Cells with points without an estimate", percent(e.without_estimate)),
            ("Hazardous terrain found", percent(d.hazardous_found)),
            ("  of it as unknown", percent(d.hazardous_unknown)),
            ("Safe terrain found", percent(d.safe_found)),
            ("  unknown", percent(d.safe_unknown)),
            ("Scanned box out of the score (unobserved)", percent(d.unseen_box)),
            (f"Truly unsafe sites in the top {TOP}", self._unsafe_sites()),
            ("Leaves with an estimate / all", f"{self.leaves_estimated} / {self.leaves}"),
        ]
        parts = ["\n".join(self.notes)] if self.notes else []
        if self.risk is not None:
            rows.append(("Brier score of the risk", f"{self.risk.brier:.4f}"))
            parts.insert(0, self.risk.table())
        return "\n\n".join(["\n".join(aligned(rows, "<")), *parts])

    def _unsafe_sites(self) -> str:
        text = f"{self.unsafe_in_top_five} of {len(self.site_verdicts)}"
        ranks = [str(k) for k, v in enumerate(self.site_verdicts, start=1) if v == "unknown"]
        return text + (f" (rank {', '.join(ranks)} beyond the true terrain)" if ranks else "")


def _show(value: float, digits: str, unit: str = "") -> str:
    return "-" if math.isnan(value) else f"{value:{digits}}{unit}"


def percent(fraction: float) -> str:
    return _show(100.0 * fraction, ".2f", " %")


def score(results: Results, truth: Truth) -> EvaluationResult:
    """Score results against the truth. Raises `EvaluationError`: map and truth do not overlap."""
    safety = metrics.safety_field(results.grid, truth)
    if min(safety.scored.size, results.grid.x.size - 1) < 1:
        msg = "has a single grid point, or does not overlap the scanned box of the truth"
        raise EvaluationError(f"the map in {results.folder} {msg}")
    return EvaluationResult(
        elevation=metrics.elevation_error(results.map, results.grid, truth),
        detection=metrics.detection(safety),
        sites=len(results.positions),
        site_verdicts=metrics.site_verdicts(results.positions[:TOP], truth),
        risk=metrics.reliability_of(safety),
        leaves=results.map.level.size,
        leaves_estimated=int(results.map.estimated.sum()),
        safety=safety,
    )
