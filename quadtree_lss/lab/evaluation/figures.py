# SPDX-License-Identifier: Apache-2.0
"""The paper's figures (9–13, 18–25) as PNG files, each named after the one it stands for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from quadtree_lss.lab.evaluation import figures_map, figures_sites
from quadtree_lss.lab.evaluation.metrics import ErrorField, SafetyField
from quadtree_lss.lab.evaluation.reliability import reliability_of
from quadtree_lss.lab.evaluation.results import Results, Truth
from quadtree_lss.onboard.arrays import Array

_DPI = 130
_TOP = 5


def draw_all(
    folder: Path, results: Results, truth: Truth, heights: ErrorField, safety: SafetyField
) -> tuple[Path, ...]:
    """Draw every figure of one run into ``folder``; returns the paths.

    A map of one level only stands for the paper's fixed-resolution map (Figs. 10, 13 instead of 9,
    12), one of several flights for FF13 + FF14 (Fig. 24 instead of 23).
    """
    leaves, grid = results.leaves, results.grid
    sites = results.sites[:_TOP]
    cells, error = (
        ("fig10_fixed_resolution_and_scans.png", "fig13_fixed_resolution_error.png")
        if leaves.fixed
        else ("fig09_quadtree_and_scans.png", "fig12_quadtree_error.png")
    )
    flights = truth.flights_of(results.stamps_ns)
    risks = reliability_of(safety)
    more = {} if risks is None else {"reliability.png": figures_sites.reliability_diagram(risks)}
    scores = "fig23_site_score.png" if flights <= 1 else "fig24_site_score_of_several_flights.png"
    return _save(
        folder,
        {
            cells: figures_map.cells_and_scans(results, truth),
            "fig11_processing_time.png": figures_map.processing_time({"map": results.map_ms}),
            error: figures_map.elevation_error(heights, truth),
            "fig18_quadtree_over_truth.png": figures_map.quadtree_over_truth(leaves, truth),
            "fig19_elevation_estimate.png": figures_map.elevation_estimate(heights, truth),
            "fig20_elevation_error.png": figures_map.elevation_error(heights, truth, centred=True),
            "fig21_true_safety.png": figures_sites.true_safety(truth),
            "fig22_classification.png": figures_sites.classification(safety, truth, sites),
            scores: figures_sites.score(grid, truth, sites),
            "fig25_selected_sites.png": figures_sites.selected_sites(
                heights, truth, {"sites": sites}
            ),
            **more,
        },
    )


def draw_together(
    folder: Path,
    truth: Truth,
    heights: ErrorField,
    map_ms: Mapping[str, Array],
    sites: Mapping[str, Array],
) -> tuple[Path, ...]:
    """Figures 11 and 25 with several runs in one picture; ``heights`` are the last run's."""
    top = {name: rows[:_TOP] for name, rows in sites.items()}
    return _save(
        folder,
        {
            "fig11_processing_time.png": figures_map.processing_time(map_ms),
            "fig25_selected_sites.png": figures_sites.selected_sites(heights, truth, top),
        },
    )


def _save(folder: Path, drawn: Mapping[str, Figure]) -> tuple[Path, ...]:
    for name, figure in drawn.items():
        FigureCanvasAgg(figure)
        figure.savefig(folder / name, dpi=_DPI)
    return tuple(folder / name for name in drawn)
