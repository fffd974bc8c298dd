# SPDX-License-Identifier: Apache-2.0
"""Scores of one run against the truth: Tables 2 and 3, and figures."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.desk.replay.files import plain, write_json, writing
from quadtree_lss.desk.replay.results import aligned
from quadtree_lss.lab.evaluation import metrics
from quadtree_lss.lab.evaluation.consistency import Consistency, consistency
from quadtree_lss.lab.evaluation.results import (
    TOP,
    EvaluationError,
    Results,
    Truth,
    check_truth,
    load_results,
    load_truth,
    recorded_bag,
)
from quadtree_lss.lab.evaluation.risk_flights import lander_of
from quadtree_lss.onboard.errors import QuadtreeLssError


@dataclass(frozen=True)
class EvaluationResult:
    """Scores of one run, and the files written.

    ``site_verdicts``: of the first five ranks. ``missed``: hazardous places called safe. ``risk``
    and ``consistency`` are None without risks and without a bag. ``notes``: what could not be done
    or checked. ``heights``, ``safety``: the compared fields.
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
    map_ms_median: float
    map_ms_p99: float
    map_s_total: float
    lss_ms: float
    heights: metrics.ErrorField
    safety: metrics.SafetyField
    consistency: Consistency | None = None
    out: Path = Path()
    figures: tuple[Path, ...] = ()
    notes: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        drawn = ("heights", "safety", "out", "figures")
        return {key: plain(value) for key, value in asdict(self).items() if key not in drawn}

    def table(self) -> str:
        e, d = self.elevation, self.detection
        times = f"{_show(self.map_ms_median, '.2f')} / {_show(self.map_ms_p99, '.2f', ' ms')}"
        rows = [
            ("Elevation error, mean absolute", _show(e.mean_absolute, ".3f", " m")),
            ("  RMS / largest", f"{_show(e.rms, '.3f')} / {_show(e.maximum, '.2f', ' m')}"),
            ("  mean", _show(e.mean, "+.3f", " m")),
            ("  RMS with the mean removed", _show(e.rms_mean_removed, ".3f", " m")),
            ("Cells with points without an estimate", _percent(e.without_estimate)),
            ("Hazardous terrain found", _percent(d.hazardous_found)),
            ("  of it as unknown", _percent(d.hazardous_unknown)),
            ("Safe terrain found", _percent(d.safe_found)),
            ("  not seen", _percent(d.safe_unknown)),
            ("Scanned box out of the score (unseen)", _percent(d.unseen_box)),
            (f"Truly unsafe sites in the top {TOP}", self._unsafe_sites()),
            ("Leaves with an estimate / all", f"{self.leaves_estimated} / {self.leaves}"),
            ("Map update, median / 99 %", times),
            ("Landing site selection", _show(self.lss_ms, ".1f", " ms")),
        ]
        tables = [part.table() for part in (self.risk, self.consistency) if part is not None]
        if self.risk is not None:
            rows.append(("Brier score of the risk", f"{self.risk.brier:.4f}"))
        notes = ["\n".join(self.notes)] if self.notes else []
        return "\n\n".join(["\n".join(aligned(rows, "<")), *tables, *notes])

    def _unsafe_sites(self) -> str:
        unknown = (k for k, v in enumerate(self.site_verdicts, start=1) if v == "unknown")
        text = f"{self.unsafe_in_top_five} of {len(self.site_verdicts)}"
        ranks = ", ".join(map(str, unknown))
        return text + bool(ranks) * f" (rank {ranks} beyond the true terrain: cannot be judged)"


def evaluate(
    results_dir: str | Path,
    truth_path: str | Path,
    out: str | Path | None = None,
    *,
    bag: str | Path | None = None,
    consistency: bool = True,
    figures: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> EvaluationResult:
    """Score results of ``replay`` against ``truth.npz``.

    Writes ``evaluation.json`` and, with ``figures``, ``report.html`` and PNG figures into ``out``
    (default: ``results_dir/evaluation``). For Table 2 (``consistency``) the ``bag``, by default the
    one that ``summary.json`` names, is mapped again; ``progress(done, total)`` counts its scans.

    Raises `EvaluationError`: a file is missing or malformed, results, truth and bag are not of one
    flight (`results.check_truth`), or map and truth do not overlap.
    """
    results, truth = load_results(results_dir), load_truth(truth_path)
    given = None if bag is None else Path(bag)
    uncertain = check_truth(results, truth, Path(truth_path), given)
    notes = [*filter(None, [uncertain]), *_other_lander(results, truth)]
    scores = score(results, truth)
    table_2 = None
    if consistency or given is not None:
        table_2, without = _table_2(results, given, progress)
        notes += [f"Table 2: {without}"] if without else []
    folder = Path(out) if out is not None else results.folder / "evaluation"
    with writing(folder, EvaluationError):
        folder.mkdir(parents=True, exist_ok=True)
    result = replace(scores, consistency=table_2, out=folder, notes=tuple(notes))
    if figures:
        from quadtree_lss.lab.evaluation.evaluation_page import evaluation_page
        from quadtree_lss.lab.evaluation.figures import draw_all

        drawn = draw_all(folder, results, truth, scores.heights, scores.safety)
        result = replace(result, figures=drawn)
        try:
            text = evaluation_page(results.folder, truth, result)
            (folder / "report.html").write_text(text, encoding="utf-8")
        except KeyError as error:  # the page needs more layers
            result = replace(result, notes=(*notes, f"report.html: the results lack {error}"))
    write_json(folder / "evaluation.json", result.as_dict())
    return result


def _other_lander(results: Results, truth: Truth) -> list[str]:
    try:
        own = lander_of(results.config).limits
    except QuadtreeLssError:  # no readable configuration, which only Table 2 needs
        return []
    if own == truth.lander.limits:
        return []
    told = "{:g} m wide, pads of {:g} m, up to {:g} deg and {:g} m of rise"
    both = told.format(*truth.lander.limits), told.format(*own)
    return ["the truth is of a lander {}, the results of one {}".format(*both)]


def _table_2(
    results: Results, given: Path | None, progress: Callable[[int, int], None] | None
) -> tuple[Consistency | None, str | None]:
    """Table 2, or the reason why there is none. Only faults of a ``given`` bag are errors."""
    bag, total = given or recorded_bag(results), results.timing["stamp_ns"].size
    if bag is None:
        return None, "needs --bag"
    if given is None and not total:
        return None, "needs --bag with the scans: these results are of recorded maps"
    scan_topic, pose_topic = (results.summary.get(f"{what}_topic") for what in ("scan", "pose"))
    try:
        return consistency(
            bag,
            results.config,
            results=results,
            scan_topic=scan_topic or None,
            pose_topic=pose_topic or None,
            progress=None if progress is None else lambda done: progress(done, max(done, total)),
        ), None
    except QuadtreeLssError as error:
        if given is not None:
            raise
        return None, f"needs --bag ({error})"


def _show(value: float, digits: str, unit: str = "") -> str:
    return "-" if math.isnan(value) else f"{value:{digits}}{unit}"


def _percent(fraction: float) -> str:
    return _show(100.0 * fraction, ".2f", " %")


def score(results: Results, truth: Truth) -> EvaluationResult:
    """Scores without Table 2. Raises `EvaluationError`: map and truth do not overlap."""
    safety = metrics.safety_field(results.grid, truth)
    if min(safety.scored.size, results.grid.x.size - 1) < 1:
        msg = "has a single grid point, or does not overlap the scanned box of the truth"
        raise EvaluationError(f"the map in {results.folder} {msg}")
    heights = metrics.elevation_field(results.map, results.grid, truth)
    verdicts = metrics.site_verdicts(results.positions[:TOP], truth)
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
        map_ms_median=float(np.median(times)),
        map_ms_p99=float(np.percentile(times, 99.0)),
        map_s_total=float(times.sum() * 1e-3),
        lss_ms=float(results.summary.get("lss_ms") or math.nan),
        heights=heights,
        safety=safety,
    )
