# SPDX-License-Identifier: Apache-2.0
"""The scores of one run against the truth, as numbers and as a table."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.desk.replay.files import plain
from quadtree_lss.lab.evaluation import metrics
from quadtree_lss.lab.evaluation.consistency import Consistency
from quadtree_lss.lab.evaluation.results import Results, Truth

_TOP = 5


@dataclass(frozen=True)
class EvaluationResult:
    """Scores of one run, and what was written.

    Sites are those of the first five ranks: ``site_verdicts`` has one word for each, in order, and
    ``unknown_in_top_five`` counts those that the truth cannot judge. ``missed`` are the hazardous
    places called safe. ``risk`` is None if the results tell none, ``consistency`` unless the bag
    was at hand; ``notes`` say what could not be done or checked, and why.
    """

    elevation: metrics.ElevationError
    detection: metrics.Detection
    sites: int
    unsafe_in_top_five: int
    unknown_in_top_five: int
    site_verdicts: tuple[metrics.SiteVerdict, ...]
    missed: tuple[metrics.MissedPlace, ...]
    risk: metrics.Reliability | None
    leaves: int
    leaves_estimated: int
    leaves_measured: int
    map_ms_median: float
    map_ms_p99: float
    map_s_total: float
    lss_ms: float
    consistency: Consistency | None
    out: Path
    figures: tuple[Path, ...]
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        values = asdict(self)
        values.pop("out")
        values.pop("figures")
        return {key: plain(value) for key, value in values.items()}

    def table(self) -> str:
        e, d = self.elevation, self.detection
        times = f"{show(self.map_ms_median, '.2f')} / {show(self.map_ms_p99, '.2f', ' ms')}"
        rows = [
            ("Elevation error, mean absolute", show(e.mean_absolute, ".3f", " m")),
            ("  RMS / largest", f"{show(e.rms, '.3f')} / {show(e.maximum, '.2f', ' m')}"),
            ("  mean", show(e.mean, "+.3f", " m")),
            ("  RMS with the mean removed", show(e.rms_mean_removed, ".3f", " m")),
            ("Cells with points without an estimate", _percent(e.without_estimate)),
            ("Hazardous terrain found", _percent(d.hazardous_found)),
            ("  of it as unknown", _percent(d.hazardous_unknown)),
            ("Safe terrain found", _percent(d.safe_found)),
            ("  not seen", _percent(d.safe_unknown)),
            ("Scanned box out of the score (unseen)", _percent(d.unseen_box)),
            (f"Truly unsafe sites in the top {_TOP}", self._unsafe_sites()),
            ("Leaves with an estimate / all", f"{self.leaves_estimated} / {self.leaves}"),
            ("Map update, median / 99 %", times),
            ("Landing site selection", show(self.lss_ms, ".1f", " ms")),
        ]
        width = max(len(label) for label, _ in rows)
        lines = [f"{label:<{width}}  {value}" for label, value in rows]
        if self.risk is not None:
            lines += [f"{'Brier score of the risk':<{width}}  {self.risk.brier:.4f}"]
            lines += ["", self.risk.table()]
        if self.consistency is not None:
            lines += ["", self.consistency.table()]
        if self.notes:
            lines += ["", *self.notes]
        return "\n".join(lines)

    def _unsafe_sites(self) -> str:
        text = f"{self.unsafe_in_top_five} of {len(self.site_verdicts)}"
        unknown = [k for k, v in enumerate(self.site_verdicts, start=1) if v == "unknown"]
        if unknown:
            ranks = ", ".join(map(str, unknown))
            text += f" (rank {ranks} beyond the true terrain: cannot be judged)"
        return text


def show(value: float, digits: str, unit: str = "") -> str:
    """A number for a table; a dash where it does not exist."""
    return "-" if math.isnan(value) else f"{value:{digits}}{unit}"


def _percent(fraction: float) -> str:
    return show(100.0 * fraction, ".2f", " %")


def scores_of(
    results: Results, truth: Truth, heights: metrics.ErrorField, safety: metrics.SafetyField
) -> EvaluationResult:
    """Those of one run, of the fields of its errors and of its safety."""
    verdicts = metrics.site_verdicts(results.positions[:_TOP], truth)
    cells, times = results.map, results.timing["map_ms"]
    times = times if times.size else np.array([math.nan])
    return EvaluationResult(
        elevation=metrics.elevation_error(heights),
        detection=metrics.detection(safety),
        sites=len(results.positions),
        unsafe_in_top_five=verdicts.count("unsafe"),
        unknown_in_top_five=verdicts.count("unknown"),
        site_verdicts=verdicts,
        missed=metrics.missed_places(safety, truth),
        risk=metrics.reliability_of(safety),
        leaves=cells.level.size,
        leaves_estimated=int(cells.estimated.sum()),
        leaves_measured=int((cells.measured & cells.estimated).sum()),
        map_ms_median=float(np.median(times)),
        map_ms_p99=float(np.percentile(times, 99.0)),
        map_s_total=float(times.sum() * 1e-3),
        lss_ms=float(results.summary.get("lss_ms") or math.nan),
        consistency=None,
        out=Path(),
        figures=(),
    )
