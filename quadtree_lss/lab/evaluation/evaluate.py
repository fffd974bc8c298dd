# SPDX-License-Identifier: Apache-2.0
"""Evaluation of one run against the truth: elevation, hazard detection (Table 3), sites, risk."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from quadtree_lss.desk.replay.files import plain, write_json, writing
from quadtree_lss.desk.replay.results import aligned
from quadtree_lss.lab.evaluation import metrics
from quadtree_lss.lab.evaluation.results import (
    TOP,
    EvaluationError,
    Results,
    Truth,
    check_truth,
    load_results,
    load_truth,
)
from quadtree_lss.lab.evaluation.risk_flights import lander_of
from quadtree_lss.onboard.errors import QuadtreeLssError


@dataclass(frozen=True)
class EvaluationResult:
    """Scores of one run; ``risk`` is None without risks, ``notes`` name parts that could
    not be checked."""

    elevation: metrics.ElevationError
    detection: metrics.Detection
    sites: int
    site_verdicts: tuple[metrics.SiteVerdict, ...]  # of the first `TOP` sites
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


def evaluate(
    results_dir: str | Path,
    truth_path: str | Path,
    out: str | Path | None = None,
    *,
    page: bool = True,
) -> EvaluationResult:
    """Score results of ``replay`` against ``truth.npz``.

    Writes ``evaluation.json`` and, with ``page``, ``report.html`` into ``out`` (default:
    ``results_dir/evaluation``). Raises `ResultsError`, `ExchangeError`: a file cannot be read;
    `EvaluationError`: it is malformed, results and truth are from different flights, or map and
    truth do not overlap.
    """
    results, truth = load_results(results_dir), load_truth(truth_path)
    check_truth(results, truth, Path(truth_path))
    result, notes = score(results, truth), _lander_notes(results, truth)
    folder = Path(out) if out is not None else results.folder / "evaluation"
    with writing(folder, EvaluationError):
        folder.mkdir(parents=True, exist_ok=True)
    result = replace(result, out=folder, notes=notes)
    if page:
        from quadtree_lss.lab.evaluation.evaluation_page import evaluation_page  # matplotlib

        try:
            text = evaluation_page(results.folder, truth, result)
            (folder / "report.html").write_text(text, encoding="utf-8")
        except KeyError as error:  # the page needs more layers
            result = replace(result, notes=(*notes, f"report.html: the results lack {error}"))
    write_json(folder / "evaluation.json", result.as_dict())
    return result


def _lander_notes(results: Results, truth: Truth) -> tuple[str, ...]:
    try:
        landers = truth.lander.limits, lander_of(results.config).limits
    except QuadtreeLssError:  # no readable configuration
        return ()
    form = "{:g} m wide, pads of {:g} m, up to {:g} deg and {:g} m of rise"
    true, own = (form.format(*limits) for limits in landers)
    return () if true == own else (f"the truth is of a lander {true}, the results of one {own}",)
