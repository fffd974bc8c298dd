# SPDX-License-Identifier: Apache-2.0
"""The paper's figures (9–13, 18–25) for one run, as PNG files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle, Patch, Rectangle

from quadtree_lss.evaluation.metrics import ErrorField, SafetyField, bilinear
from quadtree_lss.evaluation.results import BoolArray, FloatArray, Grid, Leaves, Results, Truth
from quadtree_lss.evaluation.safety import Lander

_DPI = 130
_ERROR_LIMIT = 3.0  # m, Figs. 12 and 13 saturate there

# Okabe and Ito's palette: distinct for all common kinds of colour vision.
_SAFE_FOUND, _HAZARD_FOUND, _FALSE_ALARM, _MISSED, _UNKNOWN = (
    "#56b4e9",
    "#7f7f7f",
    "#f0e442",
    "#d55e00",
    "#ffffff",
)


def draw_all(
    folder: Path, results: Results, truth: Truth, heights: ErrorField, safety: SafetyField
) -> tuple[Path, ...]:
    """Draw every figure into ``folder``; returns the paths."""
    sites = results.sites[:5]
    drawn = {
        "quadtree.png": quadtree(results.leaves, truth),
        "elevation.png": elevation_estimate(heights, truth),
        "elevation_error.png": elevation_error_map(heights, truth),
        "true_safety.png": true_safety(safety, truth),
        "classification.png": classification(safety, truth, sites),
        "score.png": score(results.grid, truth, sites),
        "sites.png": sites_over_terrain(truth, sites),
        "processing_time.png": processing_time(results.map_ms),
    }
    for name, figure in drawn.items():
        FigureCanvasAgg(figure)
        figure.savefig(folder / name, dpi=_DPI)
    return tuple(folder / name for name in drawn)


def _axes(title: str, box: tuple[float, float, float, float]) -> tuple[Figure, Axes]:
    """Axes in metres, equal in scale, showing ``box`` (xmin, xmax, ymin, ymax)."""
    figure = Figure(figsize=(7.6, 6.4), layout="constrained")
    axes = figure.add_subplot()
    axes.set(title=title, xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.set(xlim=box[:2], ylim=box[2:])
    return figure, axes


def _image(
    axes: Axes, x: FloatArray, y: FloatArray, values: np.ndarray, **style: object
) -> AxesImage:
    """An array (ny, nx) with samples at x, y."""
    dx, dy = 0.5 * float(x[1] - x[0]), 0.5 * float(y[1] - y[0])
    extent = (float(x[0]) - dx, float(x[-1]) + dx, float(y[0]) - dy, float(y[-1]) + dy)
    style = {"interpolation": "nearest", **style}
    return axes.imshow(values, origin="lower", extent=extent, **style)  # type: ignore[arg-type]


def _truth_window(
    truth: Truth, box: tuple[float, float, float, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    columns = np.flatnonzero((truth.x >= box[0]) & (truth.x <= box[1]))
    rows = np.flatnonzero((truth.y >= box[2]) & (truth.y <= box[3]))
    if columns.size < 2 or rows.size < 2:
        return truth.x, truth.y, truth.elevation
    return truth.x[columns], truth.y[rows], truth.elevation[np.ix_(rows, columns)]


def _contours(axes: Axes, truth: Truth, box: tuple[float, float, float, float]) -> None:
    x, y, z = _truth_window(truth, box)
    thin = max(1, z.shape[0] // 300)
    x, y, z = x[::thin], y[::thin], z[::thin, ::thin]
    if np.ptp(z) > 0.0:
        axes.contour(x, y, z, levels=8, colors="black", linewidths=0.4, alpha=0.6)


def _domain(leaves: Leaves) -> tuple[float, float, float, float]:
    size = leaves.domain_size
    return leaves.xmin, leaves.xmin + size, leaves.ymin, leaves.ymin + size


def _seen_box(heights: ErrorField) -> tuple[float, float, float, float]:
    """Extent of the seen ground."""
    if not heights.seen.any():
        return (
            float(heights.x[0]),
            float(heights.x[-1]),
            float(heights.y[0]),
            float(heights.y[-1]),
        )
    columns = np.flatnonzero(heights.seen.any(axis=0))
    rows = np.flatnonzero(heights.seen.any(axis=1))
    x, y = heights.x[columns], heights.y[rows]
    return float(x[0]), float(x[-1]), float(y[0]), float(y[-1])


def _around(truth: Truth) -> tuple[float, float, float, float]:
    """The scanned box and a vehicle's radius around it."""
    xmin, xmax, ymin, ymax = truth.box
    reach = 0.5 * Lander().diameter + 0.15
    return xmin - reach, xmax + reach, ymin - reach, ymax + reach


def _outline(axes: Axes, truth: Truth) -> None:
    """The scanned box."""
    xmin, xmax, ymin, ymax = truth.box
    axes.add_patch(
        Rectangle((xmin, ymin), xmax - xmin, ymax - ymin, fill=False, edgecolor="black", lw=0.8)
    )


def quadtree(leaves: Leaves, truth: Truth) -> Figure:
    """Leaf boundaries over the true elevation (Figs. 9, 10, 18)."""
    box = _domain(leaves)
    figure, axes = _axes(
        f"Quadtree: {int(leaves.estimated.sum())} leaves with an estimate of {leaves.level.size}",
        box,
    )
    x, y, z = _truth_window(truth, box)
    low, high = _limits(z)
    image = _image(axes, x, y, z, cmap="cividis", vmin=low, vmax=high)
    figure.colorbar(image, ax=axes, label="true elevation [m]", extend="both")
    half = 0.5 * leaves.size
    west, east, south, north = (
        leaves.x - half,
        leaves.x + half,
        leaves.y - half,
        leaves.y + half,
    )
    outline = np.stack(
        [
            np.stack([west, south], axis=-1),
            np.stack([east, south], axis=-1),
            np.stack([east, north], axis=-1),
            np.stack([west, north], axis=-1),
            np.stack([west, south], axis=-1),
        ],
        axis=1,
    )
    width = 0.5 if leaves.level.size < 3000 else 0.2
    axes.add_collection(LineCollection(list(outline), colors="black", linewidths=width))
    return figure


def elevation_estimate(heights: ErrorField, truth: Truth) -> Figure:
    """Estimated elevation of seen ground with the true contours (Fig. 19)."""
    box = _seen_box(heights)
    figure, axes = _axes("Elevation estimate; contours: truth", box)
    estimate = np.where(heights.seen, heights.estimate, np.nan)
    low, high = _limits(bilinear(truth, *np.meshgrid(heights.x, heights.y))[heights.seen])
    image = _image(axes, heights.x, heights.y, estimate, cmap="cividis", vmin=low, vmax=high)
    figure.colorbar(image, ax=axes, label="elevation [m]", extend="both")
    _contours(axes, truth, box)
    return figure


def _limits(values: FloatArray) -> tuple[float, float]:
    """Colour limits of elevations that a few rock tops do not stretch."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = np.percentile(finite, (0.2, 99.8))
    return float(low), float(high)


def elevation_error_map(heights: ErrorField, truth: Truth) -> Figure:
    """Absolute elevation error over seen ground, saturated at 3 m at most (Figs. 12, 13, 20)."""
    box = _seen_box(heights)
    error = np.abs(heights.error)
    finite = error[np.isfinite(error)]
    top = float(np.percentile(finite, 99.5)) if finite.size else 1.0
    top = min(max(top, 0.05), _ERROR_LIMIT)
    mean = float(finite.mean()) if finite.size else float("nan")
    figure, axes = _axes(f"Elevation error: mean absolute {mean:.3f} m", box)
    image = _image(axes, heights.x, heights.y, error, cmap="viridis", vmin=0.0, vmax=top)
    figure.colorbar(image, ax=axes, label="|estimate − truth| [m]", extend="max")
    _contours(axes, truth, box)
    return figure


def true_safety(safety: SafetyField, truth: Truth) -> Figure:
    """The true safety map (Fig. 21)."""
    figure, axes = _axes("True safety by lander contact", truth.box)
    colours = ListedColormap([_HAZARD_FOUND, _SAFE_FOUND])
    _image(axes, truth.safe_x, truth.safe_y, truth.safe.astype(int), cmap=colours, vmin=0, vmax=1)
    _contours(axes, truth, truth.box)
    figure.legend(
        handles=[
            Patch(color=_SAFE_FOUND, label="safe"),
            Patch(color=_HAZARD_FOUND, label="unsafe"),
        ],
        loc="outside lower center",
        ncols=2,
    )
    return figure


def classification(safety: SafetyField, truth: Truth, sites: FloatArray) -> Figure:
    """Verdict against truth, node by node, with the best sites (Fig. 22)."""
    figure, axes = _axes("Classification of terrain", _around(truth))
    called = safety.called_safe & safety.seen
    kind = np.select(
        [
            ~safety.scored,
            safety.truly_safe & called,
            ~safety.truly_safe & ~called,
            safety.truly_safe & ~called,
        ],
        [4, 0, 1, 2],
        3,
    )
    labels = ["safe, found", "hazard, found", "safe, called hazardous", "hazard, MISSED", "unseen"]
    colours = [_SAFE_FOUND, _HAZARD_FOUND, _FALSE_ALARM, _MISSED, _UNKNOWN]
    _image(axes, safety.x, safety.y, kind, cmap=ListedColormap(colours), vmin=0, vmax=4)
    total = max(kind.size, 1)
    handles = [
        Patch(facecolor=colour, edgecolor="black", label=f"{label} {100 * share:.1f} %")
        for colour, label, share in zip(
            colours, labels, (np.bincount(kind.ravel(), minlength=5) / total), strict=True
        )
    ]
    _outline(axes, truth)
    _mark(axes, sites)
    figure.legend(handles=handles, loc="outside lower center", ncols=3, fontsize="small")
    return figure


def _mark(axes: Axes, sites: FloatArray) -> None:
    """Sites with their rank and the lander's footprint."""
    for rank, (x, y) in enumerate(sites[:, :2], start=1):
        axes.add_patch(Circle((x, y), 0.5 * Lander().diameter, fill=False, edgecolor="black", lw=1))
        axes.annotate(
            str(rank),
            (x, y),
            ha="center",
            va="center",
            annotation_clip=True,
            fontsize="small",
            weight="bold",
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.75},
        )


def score(grid: Grid, truth: Truth, sites: FloatArray) -> Figure:
    """Score of the terrain where landing is allowed, lower is better (Figs. 23, 24)."""
    figure, axes = _axes("Site score, lower is better; white: excluded", _around(truth))
    allowed: BoolArray = grid.safe & np.isfinite(grid.score)
    values = np.where(allowed, grid.score, np.nan)
    low, high = np.percentile(grid.score[allowed], (0.5, 99.5)) if allowed.any() else (0.0, 1.0)
    image = _image(axes, grid.x, grid.y, values, cmap="viridis", vmin=low, vmax=high)
    figure.colorbar(image, ax=axes, label="score [-]", extend="both")
    _contours(axes, truth, _around(truth))
    _outline(axes, truth)
    _mark(axes, sites)
    return figure


def sites_over_terrain(truth: Truth, sites: FloatArray) -> Figure:
    """Selected sites with the vehicle's footprint over the terrain (Fig. 25)."""
    figure, axes = _axes("Selected landing sites; circles: vehicle", _around(truth))
    x, y, z = _truth_window(truth, _around(truth))
    low, high = _limits(z)
    image = _image(axes, x, y, z, cmap="cividis", vmin=low, vmax=high)
    figure.colorbar(image, ax=axes, label="true elevation [m]", extend="both")
    _outline(axes, truth)
    _mark(axes, sites)
    return figure


def processing_time(map_ms: FloatArray) -> Figure:
    """Time per scan (Fig. 11)."""
    figure = Figure(figsize=(7.6, 3.6), layout="constrained")
    axes = figure.add_subplot()
    axes.plot(np.arange(1, map_ms.size + 1), map_ms, ".-", lw=0.6, ms=3, color="#0072b2")
    axes.set(xlabel="scan", ylabel="map update [ms]", title="Processing time per scan")
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    return figure
