# SPDX-License-Identifier: Apache-2.0
"""The paper's figures (9-11, 18, 20, 22-25), named after their numbers there.

Colours are of Okabe and Ito's palette, distinct for all common kinds of colour vision.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import gaussian_filter

from quadtree_lss.desk.report import drawing
from quadtree_lss.desk.report.drawing import Box
from quadtree_lss.desk.report.palette import even_limits
from quadtree_lss.lab.evaluation.metrics import ErrorField, Reliability, SafetyField, reliability_of
from quadtree_lss.lab.evaluation.results import TOP, Results, Truth
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.tree.cell_map import CellMap

SAFE_FOUND, HAZARD_FOUND = "#56b4e9", "#7f7f7f"
VERDICTS = (
    ("safe, found", SAFE_FOUND),
    ("hazard, found", HAZARD_FOUND),
    ("safe, called hazardous", "#f0e442"),
    ("hazard, MISSED", "#d55e00"),
    ("unseen", "#dddddd"),
)
RUNS = ("#e69f00", "#0072b2", "#cc79a7", "#009e73", "#d55e00", "#56b4e9")
EVERY = 5
"""Figures 9 and 10 show every fifth scan."""
CONTOUR_SMOOTHING = 0.25
"""m."""


def draw_all(
    folder: Path, results: Results, truth: Truth, heights: ErrorField, safety: SafetyField
) -> tuple[Path, ...]:
    """Draw all figures of one run. A map of one level gets Figure 10 instead of 9, a map of several
    flights Figure 24 instead of 23."""
    sites = results.positions[:TOP]
    stamps = results.timing["stamp_ns"]
    several = np.unique(truth.scan_flight[np.isin(truth.scan_stamp_ns, stamps)]).size > 1
    cells = (
        "fig10_fixed_resolution_and_scans" if _fixed(results.map) else "fig09_quadtree_and_scans"
    )
    score = "fig24_site_score_of_several_flights" if several else "fig23_site_score"
    figures = {
        cells: _cells_and_scans(results, truth),
        "fig11_processing_time": _processing_time(results.timing["map_ms"]),
        "fig18_quadtree_over_truth": _quadtree_over_truth(results.map, truth),
        "fig20_elevation_error": _elevation_error(heights, truth),
        "fig22_classification": _classification(safety, truth, sites),
        score: _score(results, truth, sites),
        "fig25_selected_sites": _selected_sites(heights, truth, sites),
    }
    if (risks := reliability_of(safety)) is not None:
        figures["reliability"] = _reliability_diagram(risks)
    return _save(folder, figures)


def verdict_classes(safety: SafetyField) -> np.ndarray[tuple[int, ...], np.dtype[np.int64]]:
    """(ny, nx) of the field: which of `VERDICTS` each grid point is."""
    called, safe = safety.called_safe & safety.seen, safety.truly_safe
    return np.select(
        [~safety.scored, safe & called, ~safe & ~called, safe & ~called], [4, 0, 1, 2], 3
    )


def _processing_time(map_ms: Array) -> Figure:
    """Plot the time per scan, ms (Fig. 11)."""
    figure = Figure(figsize=(7.6, 3.8), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(np.arange(1, map_ms.size + 1), map_ms, ".-", lw=0.6, ms=3, color=RUNS[0])
    axes.set(xlabel="scan [-]", ylabel="map update [ms]")
    title = f"Processing time per scan, {1e-3 * map_ms.sum():.2f} s in total"
    axes.set_title(title, fontsize="medium")
    axes.set_ylim(bottom=0.0)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(alpha=0.3)
    return figure


def _save(folder: Path, figures: Mapping[str, Figure]) -> tuple[Path, ...]:
    paths = tuple(folder / f"{name}.png" for name in figures)
    for path, figure in zip(paths, figures.values(), strict=True):
        path.write_bytes(drawing.png(figure))
    return paths


def _map(title: str, box: Box) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(7.6, 6.6), layout="constrained")
    axes = figure.add_subplot()
    drawing.map_axes(axes, title, box)
    return figure, axes


def _cells_and_scans(results: Results, truth: Truth) -> Figure:
    """Boundaries of the leaves and of every fifth scan (Figs. 9, 10)."""
    cells = results.map
    shown, total = truth.outlines_of(results.timing["stamp_ns"], EVERY)
    kind = "Fixed-resolution cells" if _fixed(cells) else "Quadtree cells"
    scans = f"outlines of every {EVERY}th of {total} scans" if total else "no scan outlines known"
    figure, axes = _map(f"{kind}, {_count(cells)}; {scans}", _domain(cells))
    drawing.outline(axes, cells, ~cells.estimated, colors="#bbbbbb", linewidths=0.4)
    drawing.outline(axes, cells, cells.estimated)
    if total:
        lines = LineCollection(list(shown), linewidths=0.9, cmap="viridis")
        lines.set_array(1 + EVERY * np.arange(len(shown)))
        axes.add_collection(lines)
        figure.colorbar(lines, ax=axes, label="scan [-]", ticks=MaxNLocator(integer=True))
    return figure


def _fixed(cells: CellMap) -> bool:
    return cells.domain.min_level == cells.domain.max_level


def _domain(cells: CellMap) -> Box:
    of = cells.domain
    return of.xmin, of.xmin + of.size, of.ymin, of.ymin + of.size


def _count(cells: CellMap) -> str:
    return f"{int(cells.estimated.sum())} with an estimate of {cells.level.size}"


def _quadtree_over_truth(cells: CellMap, truth: Truth) -> Figure:
    """Leaf boundaries over the true elevation (Fig. 18)."""
    box = _domain(cells)
    figure, axes = _map(f"Quadtree over the true elevation: leaves, {_count(cells)}", box)
    x, y, z = _window(truth, box)
    _relief(figure, axes, x, y, z, z, "true elevation [m]")
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
    label = "estimate − truth [m]; grey: not observed"
    _coloured(axes, heights.x, heights.y, error, "error", even_limits(error), label)
    _contours(axes, truth, box)
    return figure


def _classification(safety: SafetyField, truth: Truth, sites: Array) -> Figure:
    """Verdict against truth, point by point, with the best sites (Fig. 22)."""
    figure, axes = _map("Classification of terrain and the best sites", _around(truth))
    kind = verdict_classes(safety)
    labels, colours = zip(*VERDICTS, strict=True)
    drawing.classes(axes, safety.x, safety.y, kind, colours)
    shares = np.bincount(kind.ravel(), minlength=5) / max(kind.size, 1)
    handles = [
        Patch(facecolor=colour, edgecolor="black", label=f"{label} {100 * share:.2f} %")
        for colour, label, share in zip(colours, labels, shares, strict=True)
    ]
    _box_and_sites(axes, truth, sites)
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize="small")
    return figure


def _score(results: Results, truth: Truth, sites: Array) -> Figure:
    """Score of the terrain where landing is allowed, lower is better (Figs. 23, 24)."""
    grid, box = results.grid, _around(truth)
    figure, axes = _map("Site score, lower is better; white: excluded", box)
    values = np.where(grid["safe"] & np.isfinite(grid["score"]), grid["score"], np.nan)
    _coloured(axes, grid.x, grid.y, values, "score", _limits(values, 0.5), "score [-]")
    _contours(axes, truth, box)
    _box_and_sites(axes, truth, sites)
    return figure


def _selected_sites(heights: ErrorField, truth: Truth, sites: Array) -> Figure:
    """Draw the sites over the mapped elevation (Fig. 25)."""
    figure, axes = _map("Selected landing sites over the mapped terrain", _around(truth))
    estimate = np.where(heights.seen, heights.estimate, np.nan)
    _relief(figure, axes, heights.x, heights.y, estimate, estimate, "estimated elevation [m]")
    _box_and_sites(axes, truth, sites)
    return figure


def _reliability_diagram(found: Reliability) -> Figure:
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


def _relief(figure: Figure, axes: Any, x: Array, y: Array, z: Array, of: Array, label: str) -> None:
    """Shaded elevations ``z``, with colours for most of the elevations ``of``."""
    shown = drawing.layer(axes, x, y, z, limits=_limits(of))
    figure.colorbar(shown, ax=axes, label=label, extend="both")


def _coloured(
    axes: Any, x: Array, y: Array, z: Array, kind: str, limits: tuple[float, float], label: str
) -> None:
    """Values by a colour map of `drawing.MAPS`, unshaded."""
    style = {"cmap": drawing.MAPS[kind], "vmin": limits[0], "vmax": limits[1]}
    shown = drawing.image(axes, x, y, z, **style)
    axes.figure.colorbar(shown, ax=axes, label=label, extend="both")


def _limits(values: Array, beyond: float = 0.2) -> tuple[float, float]:
    """Percentiles ``beyond`` and 100 - ``beyond`` of finite values."""
    finite = values[np.isfinite(values)]
    low, high = np.percentile(finite, (beyond, 100.0 - beyond)) if finite.size else (0.0, 1.0)
    return float(low), float(high)


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
    low, high = _limits(z)
    if high > low:
        levels = np.linspace(low, high, 9)
        axes.contour(x, y, z, levels=levels, colors="black", linewidths=0.4, alpha=0.6)


def _around(truth: Truth) -> Box:
    """The scanned box and the lander's reach around it."""
    xmin, xmax, ymin, ymax = truth.box
    reach = truth.lander.reach
    return xmin - reach, xmax + reach, ymin - reach, ymax + reach


def _box_and_sites(axes: Axes, truth: Truth, sites: Array) -> None:
    """Draw the scanned box, and sites with the lander's circle."""
    xmin, xmax, ymin, ymax = truth.box
    box = Rectangle((xmin, ymin), xmax - xmin, ymax - ymin, fill=False, edgecolor="black", lw=0.8)
    axes.add_patch(box)
    drawing.mark_sites(axes, sites, 0.5 * truth.lander.diameter)
