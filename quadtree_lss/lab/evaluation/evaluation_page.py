# SPDX-License-Identifier: Apache-2.0
"""The page of an evaluation: the report of the results with truth, error and verdicts."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from quadtree_lss.desk.exchange.saved import load_results
from quadtree_lss.desk.report.page_data import Layer
from quadtree_lss.desk.report.palette import colour_limits, even_limits
from quadtree_lss.desk.report.report import page, short_name
from quadtree_lss.lab.evaluation.evaluate import EvaluationResult, percent
from quadtree_lss.lab.evaluation.results import Truth

#: Verdicts on grid points with colours from the palette of Okabe and Ito.
VERDICTS = (
    ("safe, found", "#56b4e9"),
    ("hazard, found", "#7f7f7f"),
    ("safe, called hazardous", "#f0e442"),
    ("hazard, MISSED", "#d55e00"),
    ("unseen", "#dddddd"),
)


def evaluation_page(folder: Path, truth: Truth, result: EvaluationResult) -> str:
    """Render the page. Raises `KeyError`: the results lack an array that a page shows."""
    content, safety = load_results(folder), result.safety
    grid = content.grid
    true = truth.elevation_at(*np.meshgrid(grid["x"], grid["y"]))
    error = np.where(grid.seen, grid["elevation"] - true, np.nan)
    mean = float(np.nanmean(error)) if np.isfinite(error).any() else 0.0
    called, safe = safety.called_safe & safety.seen, safety.truly_safe
    cases = ~safety.scored, safe & called, ~safe & ~called, safe & ~called
    classes = np.full(grid["hazard"].shape, 4, dtype=np.uint8)
    rows = np.searchsorted(grid["y"], safety.y - 1e-6)
    classes[np.ix_(rows, np.searchsorted(grid["x"], safety.x - 1e-6))] = np.select(
        cases, [4, 0, 1, 2], 3
    )
    note = f"Estimate minus truth, without the mean error of navigation, {mean:+.3f} m."
    where = "For the centre of the lander. "
    title, limits = "Error of the elevation, mean removed", even_limits(error - mean)
    layers = (
        Layer("verdict", "Verdict against the truth", classes, classes=VERDICTS, note=where),
        Layer("truth", "True elevation", true, "m", limits=colour_limits(true[grid.seen])),
        Layer("error", title, error - mean, "m", "error", limits, note=note),
    )
    found, heights, places = result.detection, result.elevation, content.positions
    return page(
        content,
        layers,
        "lab/evaluation/evaluation.html",
        title=f"Evaluation of {short_name(content.summary['bag'])}",
        lead=(
            f"{result.unsafe_in_top_five} of the first {len(result.site_verdicts)} sites truly"
            f" unsafe, {percent(found.hazardous_found)} of the hazardous and"
            f" {percent(found.safe_found)} of the safe terrain found, elevation RMS"
            f" {heights.rms:.3f} m ({heights.rms_mean_removed:.3f} m with the mean removed)"
        ),
        bad=bool(result.unsafe_in_top_five or found.missed_depth > 0.5),
        sites=[(*at[:2], v) for at, v in zip(places, result.site_verdicts, strict=False)],
        scores=result.table(),
    )
