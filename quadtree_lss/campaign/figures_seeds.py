# SPDX-License-Identifier: Apache-2.0
"""One picture of many seeds: hazards found against safe ground found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from quadtree_lss.campaign.seed_summary import SeedsResult
from quadtree_lss.evaluation.plotting import RUNS

PAPER = {"FF13": (44.36, 99.09), "FF14": (36.06, 99.84), "FF13 + FF14": (35.11, 99.20)}
"""Table 3 of the paper: safe and hazardous terrain found (%)."""


def draw_seeds(path: Path, result: SeedsResult) -> None:
    """A point per seed; the paper's flights beside them."""
    figure = Figure(figsize=(6.4, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    seeds = list(result.scored)
    scores = [result.scored[seed].detection for seed in seeds]
    safe = 100.0 * np.array([d.safe_found for d in scores])
    hazardous = 100.0 * np.array([d.hazardous_found for d in scores])
    axes.plot(
        safe,
        hazardous,
        "o",
        ms=5,
        color=RUNS[1],
        label="1 seed" if len(seeds) == 1 else f"{len(seeds)} seeds",
    )
    if np.isfinite(safe).any() and np.isfinite(hazardous).any():
        mean = np.nanmean(safe), np.nanmean(hazardous)
        axes.plot(*mean, "D", ms=8, color=RUNS[0], mec="black", label="their mean")
        worst = int(np.nanargmin(hazardous))
        axes.annotate(
            f"seed {seeds[worst]}",
            (safe[worst], hazardous[worst]),
            textcoords="offset points",
            xytext=(6, -10),
            fontsize="small",
        )
    x, y = np.array(list(PAPER.values())).T
    axes.plot(x, y, "s", ms=6, color="black", mfc="none", label="the paper's flights (Table 3)")
    axes.set(xlabel="safe terrain found [%]", ylabel="hazardous terrain found [%]", xlim=(0, 100))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    figure.savefig(path, dpi=130)
