# SPDX-License-Identifier: Apache-2.0
"""The page of an evaluation: that of the results, with the truth, the error and the verdicts."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from quadtree_lss.desk.report.content import Content, read
from quadtree_lss.desk.report.page_data import Layer
from quadtree_lss.desk.report.palette import colour_limits, even_limits
from quadtree_lss.desk.report.report import page, short_name
from quadtree_lss.lab.evaluation.metrics import SafetyField
from quadtree_lss.lab.evaluation.plotting import (
    FALSE_ALARM,
    HAZARD_FOUND,
    MISSED,
    SAFE_FOUND,
    UNSEEN_GROUND,
)
from quadtree_lss.lab.evaluation.results import Truth

if TYPE_CHECKING:
    from quadtree_lss.lab.evaluation.evaluate import EvaluationResult

VERDICTS = (
    ("safe, found", SAFE_FOUND),
    ("hazard, found", HAZARD_FOUND),
    ("safe, called hazardous", FALSE_ALARM),
    ("hazard, MISSED", MISSED),
    ("unseen", UNSEEN_GROUND),
)
"""Classes of the grid points, in the order of `verdict_classes`."""


def evaluation_page(
    folder: Path, truth: Truth, safety: SafetyField, result: EvaluationResult
) -> str:
    """The page as text.

    Raises:
        KeyError: the results lack an array that a page shows.
    """
    content = read(folder)
    grid = content.grid
    true = truth.elevation_at(*np.meshgrid(grid["x"], grid["y"]))
    error = np.where(content.seen, grid["elevation"] - true, np.nan)
    mean = float(np.nanmean(error)) if np.isfinite(error).any() else 0.0
    classes = np.full(grid["hazard"].shape, 4, dtype=np.uint8)
    rows = np.searchsorted(grid["y"], safety.y - 1e-6)
    classes[np.ix_(rows, np.searchsorted(grid["x"], safety.x - 1e-6))] = verdict_classes(safety)
    layers = (
        Layer(
            "verdict",
            "Verdict against the truth",
            classes,
            classes=VERDICTS,
            note="Where the lander's centre would be. ",
        ),
        Layer("truth", "True elevation", true, "m", limits=colour_limits(true[content.seen])),
        Layer(
            "error",
            "Error of the elevation, mean removed",
            error - mean,
            "m",
            "error",
            even_limits(error - mean),
            note=f"Estimate less truth; the mean of {mean:+.3f} m, navigation's, is taken away.",
        ),
    )
    title = f"Evaluation of {short_name(content.summary['bag'])}"
    return page(
        content, title=title, layers=layers, lead=_lead(result), more=_tables(content, result)
    )


def verdict_classes(safety: SafetyField) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """(ny, nx) of the field: which of `VERDICTS` each grid point is."""
    called = safety.called_safe & safety.seen
    return np.select(
        [
            ~safety.scored,
            safety.truly_safe & called,
            ~safety.truly_safe & ~called,
            safety.truly_safe & ~called,
        ],
        [4, 0, 1, 2],
        3,
    )


def _lead(result: EvaluationResult) -> str:
    """The scores in a sentence."""
    found, heights = result.detection, result.elevation
    top = len(result.site_verdicts)
    text = (
        f"{result.unsafe_in_top_five} of the first {top} sites truly unsafe, "
        f"{_percent(found.hazardous_found)} of the hazardous and {_percent(found.safe_found)} of"
        f" the safe terrain found, elevation RMS {heights.rms:.3f} m"
        f" ({heights.rms_mean_removed:.3f} m with the mean removed)"
    )
    bad = result.unsafe_in_top_five or found.missed_depth > 0.5
    return f'<p class="verdict{" none" if bad else ""}"><b>Truth:</b> {escape(text)}.</p>'


def _percent(share: float) -> str:
    return "–" if share != share else f"{100.0 * share:.1f} %"


def _tables(content: Content, result: EvaluationResult) -> str:
    """The verdict on each site and the missed places, each a link to the place."""

    def there(x: float, y: float) -> str:
        address = f"#layer=verdict&amp;x={x:.2f}&amp;y={y:.2f}&amp;scale=40"
        return f'<a href="{address}">{x:.2f}, {y:.2f}</a>'

    sites = "".join(
        f"<tr><th>{rank}</th><td>{there(x, y)}</td><td>{verdict}</td></tr>"
        for rank, (x, y, verdict) in enumerate(
            zip(content.sites["x"], content.sites["y"], result.site_verdicts, strict=False), start=1
        )
    )
    missed = "".join(
        f"<tr><td>{there(place.x, place.y)}</td><td>{place.grid_points}</td>"
        f"<td>{place.depth:.2f}</td><td>{place.relief:.2f}</td></tr>"
        for place in result.missed
    )
    head = "<th>x, y, m</th><th>grid points</th><th>depth, m</th><th>relief, m</th>"
    none = "<p>No hazardous ground was called safe.</p>"
    missed = f'<div class="scroll"><table><tr>{head}</tr>{missed}</table></div>' if missed else none
    head = "<th>site</th><th>x, y, m</th><th>truly</th>"
    return (
        f'<div class="columns"><div><h2>Sites</h2><table><tr>{head}</tr>{sites}</table></div>'
        f"<div><h2>Hazardous ground called safe</h2>{missed}</div></div>"
        f"<h2>Scores</h2><pre>{escape(result.table())}</pre>"
    )
