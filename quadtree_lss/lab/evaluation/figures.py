# SPDX-License-Identifier: Apache-2.0
"""Figures 18, 20 and 22 of the paper, named after their numbers there, and the reliability diagram.

Colours are of Okabe and Ito's palette, distinct for all common kinds of colour vision.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from scipy.ndimage import gaussian_filter

from quadtree_lss.desk.report import drawing
from quadtree_lss.desk.report.drawing import Box
from quadtree_lss.desk.report.palette import MAPS, colour_limits, even_limits
from quadtree_lss.lab.evaluation.metrics import ErrorField, Reliability, SafetyField, reliability_of
from quadtree_lss.lab.evaluation.results import TOP, Results, Truth
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.tree.cell_map import CellMap

VERDICTS = (
    ("safe, found", "#56b4e9"),
    ("hazard, found", "#7f7f7f"),
    ("safe, called hazardous", "#f0e442"),
    ("hazard, MISSED", "#d55e00"),
    ("unseen", "#dddddd"),
)
#: Standard deviation of the smoothing before contour lines are drawn, m.
CONTOUR_SMOOTHING = 0.25


def draw_all(
    folder: Path, results: Results, truth: Truth, heights: ErrorField, safety: SafetyField
) -> tuple[Path, ...]:
    """Write all figures of one run into a folder."""
    figures = {
        "fig18_quadtree_over_truth": _quadtree_over_truth(results.map, truth),
        "fig20_elevation_error": _elevation_error(heights, truth),
        "fig22_classification": _classification(safety, truth, results.positions[:TOP]),
    }
    if (risks := reliability_of(safety)) is not None:
        figures["reliability"] = _reliability_diagram(risks)
    for name, figure in figures.items():
        (folder / f"{name}.png").write_bytes(drawing.png(figure))
    return tuple(folder / f"{name}.png" for name in figures)


def verdict_classes(safety: SafetyField) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """(ny, nx) of the field: which of `VERDICTS` each grid point is."""
    called, safe = safety.called_safe & safety.seen, safety.truly_safe
    return np.select(
        [~safety.scored, safe & called, ~safe & ~called, safe & ~called], [4, 0, 1, 2], 3
    )


def _map(title: str, box: Box) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7.6, 6.6), layout="constrained")
    axes = figure.add_subplot()
    drawing.map_axes(axes, title, box)
    return figure, axes


def _quadtree_over_truth(cells: CellMap, truth: Truth) -> Figure:
    """Leaf boundaries over the true elevation (Fig. 18)."""
    of = cells.domain
    box = of.xmin, of.xmin + of.size, of.ymin, of.ymin + of.size
    count = f"{int(cells.estimated.sum())} with an estimate of {cells.level.size}"
    figure, axes = _map(f"Quadtree over the true elevation: leaves, {count}", box)
    x, y, z = _window(truth, box)
    shown = drawing.layer(axes, x, y, z, limits=colour_limits(z))
    figure.colorbar(shown, ax=axes, label="true elevation [m]", extend="both")
    drawing.outline(axes, cells, alpha=0.4)
    return figure


def _elevation_error(heights: ErrorField, truth: Truth) -> Figure:
    """Estimate minus truth without its mean (Fig. 20). The scale covers 99 % of the errors."""
    seen = heights.seen if heights.seen.any() else np.ones_like(heights.seen)
    box = drawing.extent(heights.x[seen.any(axis=0)], heights.y[seen.any(axis=1)])
    mean = float(np.nanmean(heights.error)) if heights.seen.any() else 0.0
    error = heights.error - mean
    finite = np.abs(error[np.isfinite(error)])
    title = "nothing to compare"
    if finite.size:
        title = f"mean absolute {finite.mean():.3f} m, largest {finite.max():.2f} m"
        title += f"; mean of {mean:+.3f} m removed"
    figure, axes = _map(f"Elevation error: {title}", box)
    axes.set_facecolor("#dddddd")
    low, high = even_limits(error)
    style = {"cmap": MAPS["error"], "vmin": low, "vmax": high}
    shown = drawing.image(axes, heights.x, heights.y, error, **style)
    label = "estimate − truth [m]; grey: not observed"
    figure.colorbar(shown, ax=axes, label=label, extend="both")
    _contours(axes, truth, box)
    return figure


def _classification(safety: SafetyField, truth: Truth, sites: Array) -> Figure:
    """Verdict against truth, point by point, with the best sites (Fig. 22)."""
    xmin, xmax, ymin, ymax = truth.box
    reach = truth.lander.reach
    around = xmin - reach, xmax + reach, ymin - reach, ymax + reach
    figure, axes = _map("Classification of terrain and the best sites", around)
    kind = verdict_classes(safety)
    labels, colours = zip(*VERDICTS, strict=True)
    drawing.classes(axes, safety.x, safety.y, kind, colours)
    shares = np.bincount(kind.ravel(), minlength=5) / max(kind.size, 1)
    handles = [
        Patch(facecolor=colour, edgecolor="black", label=f"{label} {100 * share:.2f} %")
        for colour, label, share in zip(colours, labels, shares, strict=True)
    ]
    width, height = xmax - xmin, ymax - ymin
    axes.add_patch(Rectangle((xmin, ymin), width, height, fill=False, edgecolor="black", lw=0.8))
    drawing.mark_sites(axes, sites, 0.5 * truth.lander.diameter)
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize="small")
    return figure


def _reliability_diagram(found: Reliability) -> Figure:
    """The truly unsafe share over the predicted risk."""
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


def _window(truth: Truth, box: Box) -> tuple[Array, Array, Array]:
    """The part of the DEM inside a box: x, y, elevation."""
    columns = np.flatnonzero((truth.x >= box[0]) & (truth.x <= box[1]))
    rows = np.flatnonzero((truth.y >= box[2]) & (truth.y <= box[3]))
    if columns.size < 2 or rows.size < 2:
        return truth.x, truth.y, truth.elevation
    return truth.x[columns], truth.y[rows], truth.elevation[np.ix_(rows, columns)]


def _contours(axes: Axes, truth: Truth, box: Box) -> None:
    """Contour lines of the true elevation."""
    x, y, z = _window(truth, box)
    z = gaussian_filter(z, CONTOUR_SMOOTHING / (x[1] - x[0]))
    thin = max(1, z.shape[0] // 300)
    x, y, z = x[::thin], y[::thin], z[::thin, ::thin]
    low, high = colour_limits(z)
    if high > low:
        levels = np.linspace(low, high, 9)
        axes.contour(x, y, z, levels=levels, colors="black", linewidths=0.4, alpha=0.6)
