# SPDX-License-Identifier: Apache-2.0
"""Figures of safety and landing sites (Figs. 21–25)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from quadtree_lss.lab.evaluation.metrics import ErrorField, SafetyField
from quadtree_lss.lab.evaluation.page import VERDICTS, verdict_classes
from quadtree_lss.lab.evaluation.plotting import (
    HAZARD_FOUND,
    RUNS,
    SAFE_FOUND,
    around,
    contours,
    image,
    limits,
    map_axes,
    mark,
    outline,
    relief,
)
from quadtree_lss.lab.evaluation.reliability import Reliability
from quadtree_lss.lab.evaluation.results import Grid, Truth
from quadtree_lss.onboard.arrays import Array, Mask


def true_safety(truth: Truth) -> Figure:
    """The true safety map (Fig. 21)."""
    title = f"True safety by lander contact: {100.0 * truth.safe.mean():.1f} % safe"
    figure, axes = map_axes(title, truth.box)
    colours = ListedColormap([HAZARD_FOUND, SAFE_FOUND])
    image(axes, truth.safe_x, truth.safe_y, truth.safe.astype(int), cmap=colours, vmin=0, vmax=1)
    contours(axes, truth, truth.box)
    handles = [Patch(color=SAFE_FOUND, label="safe"), Patch(color=HAZARD_FOUND, label="unsafe")]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return figure


def classification(safety: SafetyField, truth: Truth, sites: Array) -> Figure:
    """Verdict against truth, point by point, with the best sites (Fig. 22)."""
    figure, axes = map_axes("Classification of terrain and the best sites", around(truth))
    kind = verdict_classes(safety)
    labels, colours = zip(*VERDICTS, strict=True)
    image(axes, safety.x, safety.y, kind, cmap=ListedColormap(colours), vmin=0, vmax=4)
    shares = np.bincount(kind.ravel(), minlength=5) / max(kind.size, 1)
    handles = [
        Patch(facecolor=colour, edgecolor="black", label=f"{label} {100 * share:.2f} %")
        for colour, label, share in zip(colours, labels, shares, strict=True)
    ]
    outline(axes, truth)
    mark(axes, sites)
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize="small")
    return figure


def score(grid: Grid, truth: Truth, sites: Array) -> Figure:
    """Score of the terrain where landing is allowed, lower is better (Figs. 23, 24)."""
    figure, axes = map_axes("Site score, lower is better; white: excluded", around(truth))
    allowed: Mask = grid.safe & np.isfinite(grid.score)
    values = np.where(allowed, grid.score, np.nan)
    low, high = np.percentile(grid.score[allowed], (0.5, 99.5)) if allowed.any() else (0.0, 1.0)
    shown = image(axes, grid.x, grid.y, values, cmap="viridis_r", vmin=low, vmax=high)
    figure.colorbar(shown, ax=axes, label="score [-]", extend="both")
    contours(axes, truth, around(truth))
    outline(axes, truth)
    mark(axes, sites)
    return figure


def selected_sites(heights: ErrorField, truth: Truth, runs: Mapping[str, Array]) -> Figure:
    """Sites of one or several runs over the mapped elevation (Fig. 25).

    The paper shows binned measurements below them; results hold no points, so the map does here.
    """
    figure, axes = map_axes("Selected landing sites over the mapped terrain", around(truth))
    estimate = np.where(heights.seen, heights.estimate, np.nan)
    low, high = limits(estimate)
    shown = relief(axes, heights.x, heights.y, estimate, low, high)
    figure.colorbar(shown, ax=axes, label="estimated elevation [m]", extend="both")
    outline(axes, truth)
    several = len(runs) > 1
    for colour, (name, sites) in zip(RUNS * len(runs), runs.items(), strict=False):
        mark(axes, sites, colour if several else "black", name if several else None)
    if several:
        figure.legend(loc="outside lower center", ncols=min(len(runs), 3), fontsize="small")
    return figure


def reliability_diagram(found: Reliability) -> Figure:
    """Truly unsafe share over predicted risk."""
    figure = Figure(figsize=(5.0, 4.6), layout="constrained")
    axes = figure.subplots()
    ends = np.array([1e-4, 1.0])
    axes.fill_between(ends, ends / 2.0, ends * 2.0, color="0.9", label="within a factor of 2")
    axes.plot(ends, ends, color="0.4", linewidth=0.8)
    some = [b for b in found.bins if b.grid_points]
    shares = np.array([b.unsafe for b in some])
    axes.plot([b.predicted for b in some], np.maximum(shares, 1e-4), "o-", color="#0072b2")
    axes.set(xscale="log", yscale="log", xlim=ends, ylim=ends)
    axes.set(xlabel="predicted risk", ylabel="truly unsafe share")
    axes.set_title(f"Risk of landing: Brier score {found.brier:.4f}", fontsize="medium")
    axes.legend(loc="upper left", fontsize="small")
    return figure
