# SPDX-License-Identifier: Apache-2.0
"""Figures of the map: cells, scans, elevation and its error, time (Figs. 9–13, 18–20)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from quadtree_lss.desk.report.palette import MAPS, even_limits
from quadtree_lss.lab.evaluation.metrics import ErrorField
from quadtree_lss.lab.evaluation.plotting import (
    RUNS,
    Box,
    contours,
    image,
    limits,
    map_axes,
    relief,
    truth_window,
)
from quadtree_lss.lab.evaluation.results import Leaves, Results, Truth
from quadtree_lss.onboard.arrays import Array

EVERY = 5
"""Figs. 9 and 10 show the outline of every fifth scan."""


def cells_and_scans(results: Results, truth: Truth) -> Figure:
    """Boundaries of the leaves and of every fifth scan (Figs. 9, 10)."""
    leaves = results.leaves
    shown, total = truth.outlines_of(results.stamps_ns, EVERY)
    box = _around_all(leaves, shown)
    kind = "Fixed-resolution cells" if leaves.fixed else "Quadtree cells"
    count = f"{int(leaves.estimated.sum())} with an estimate of {leaves.level.size}"
    scans = f"outlines of every {EVERY}th of {total} scans" if total else "no scan outlines known"
    figure, axes = map_axes(f"{kind}, {count}; {scans}", box)
    edges = _edges(leaves)
    empty, full = edges[~leaves.estimated], edges[leaves.estimated]
    axes.add_collection(LineCollection(list(empty), colors="#bbbbbb", linewidths=0.4))
    axes.add_collection(LineCollection(list(full), colors="black", linewidths=_width(leaves)))
    if total:
        lines = LineCollection(list(shown), linewidths=0.9, cmap="viridis")
        lines.set_array(1 + EVERY * np.arange(len(shown)))
        axes.add_collection(lines)
        figure.colorbar(lines, ax=axes, label="scan [-]", ticks=MaxNLocator(integer=True))
    return figure


def _around_all(leaves: Leaves, outlines: Array) -> Box:
    """The domain, and a little of what scans saw beyond."""
    xmin, xmax, ymin, ymax = domain(leaves)
    room = 0.1 * leaves.domain.size
    if outlines.size and np.isfinite(outlines).any():
        low, high = np.nanmin(outlines, axis=(0, 1)), np.nanmax(outlines, axis=(0, 1))
        xmin, xmax = max(min(xmin, low[0]), xmin - room), min(max(xmax, high[0]), xmax + room)
        ymin, ymax = max(min(ymin, low[1]), ymin - room), min(max(ymax, high[1]), ymax + room)
    return float(xmin), float(xmax), float(ymin), float(ymax)


def domain(leaves: Leaves) -> Box:
    """Extent of the map."""
    of = leaves.domain
    return of.xmin, of.xmin + of.size, of.ymin, of.ymin + of.size


def _edges(leaves: Leaves) -> Array:
    """Closed outlines of the leaves (M, 5, 2)."""
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]], float)
    centre = np.stack([leaves.x, leaves.y], axis=-1)
    return np.asarray(centre[:, None, :] + 0.5 * leaves.size[:, None, None] * corner)


def _width(leaves: Leaves) -> float:
    return float(np.clip(30.0 / np.sqrt(max(leaves.level.size, 1)), 0.15, 0.6))


def quadtree_over_truth(leaves: Leaves, truth: Truth) -> Figure:
    """Leaf boundaries over the true elevation (Fig. 18)."""
    box = domain(leaves)
    title = f"{int(leaves.estimated.sum())} leaves with an estimate of {leaves.level.size}"
    figure, axes = map_axes(f"Quadtree over the true elevation: {title}", box)
    x, y, z = truth_window(truth, box)
    low, high = limits(z)
    shown = relief(axes, x, y, z, low, high)
    figure.colorbar(shown, ax=axes, label="true elevation [m]", extend="both")
    axes.add_collection(
        LineCollection(list(_edges(leaves)), colors="black", linewidths=_width(leaves), alpha=0.4)
    )
    return figure


def elevation_estimate(heights: ErrorField, truth: Truth) -> Figure:
    """Estimated elevation of seen ground with the true contours (Fig. 19)."""
    box = _seen_box(heights)
    figure, axes = map_axes("Elevation estimate; contours: truth", box)
    estimate = np.where(heights.seen, heights.estimate, np.nan)
    low, high = limits(truth.elevation_at(*np.meshgrid(heights.x, heights.y))[heights.seen])
    shown = relief(axes, heights.x, heights.y, estimate, low, high)
    figure.colorbar(shown, ax=axes, label="elevation [m]", extend="both")
    contours(axes, truth, box)
    return figure


def elevation_error(heights: ErrorField, truth: Truth, *, centred: bool = False) -> Figure:
    """Estimate minus truth over seen ground (Figs. 12, 13; ``centred``, without the mean, Fig. 20).

    The scale holds 99 % of the errors; the paper's saturates at 3 m, where most do not show.
    """
    box = _seen_box(heights)
    mean = float(np.nanmean(heights.error)) if centred and heights.seen.any() else 0.0
    error = heights.error - mean
    finite = np.abs(error[np.isfinite(error)])
    low, high = even_limits(error)
    title = "Elevation error: nothing to compare"
    if finite.size:
        title = (
            f"Elevation error: mean absolute {finite.mean():.3f} m, largest {finite.max():.2f} m"
            + (f"; mean of {mean:+.3f} m removed" if centred else "")
        )
    figure, axes = map_axes(title, box)
    axes.set_facecolor("#dddddd")
    options = {"cmap": MAPS["error"], "vmin": low, "vmax": high}
    shown = image(axes, heights.x, heights.y, error, **options)
    label = "estimate − truth [m]; grey: not seen"
    figure.colorbar(shown, ax=axes, label=label, extend="both")
    contours(axes, truth, box)
    return figure


def _seen_box(heights: ErrorField) -> Box:
    """Extent of the seen ground."""
    seen = heights.seen if heights.seen.any() else np.ones_like(heights.seen)
    x, y = heights.x[seen.any(axis=0)], heights.y[seen.any(axis=1)]
    dx, dy = 0.5 * (heights.x[1] - heights.x[0]), 0.5 * (heights.y[1] - heights.y[0])
    return float(x[0] - dx), float(x[-1] + dx), float(y[0] - dy), float(y[-1] + dy)


def processing_time(runs: Mapping[str, Array]) -> Figure:
    """Time per scan (ms) of one or several runs (Fig. 11)."""
    figure = Figure(figsize=(7.6, 3.8), layout="constrained")
    axes = figure.add_subplot()
    for colour, (name, map_ms) in zip(RUNS * len(runs), runs.items(), strict=False):
        label = f"{name}: {1e-3 * map_ms.sum():.2f} s in all"
        scans = np.arange(1, map_ms.size + 1)
        axes.plot(scans, map_ms, ".-", lw=0.6, ms=3, color=colour, label=label)
    axes.set(xlabel="scan [-]", ylabel="map update [ms]")
    axes.set_title("Processing time per scan", fontsize="medium")
    axes.set_ylim(bottom=0.0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    return figure
