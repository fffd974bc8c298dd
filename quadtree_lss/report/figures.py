# SPDX-License-Identifier: Apache-2.0
"""Figures of a map and its landing sites; each function returns a matplotlib figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar  # type: ignore[import-untyped]
from numpy.typing import NDArray

from quadtree_lss.config.settings import Config
from quadtree_lss.core.landing.sites import LandingAssessment
from quadtree_lss.core.tree.cell_map import CellMap

if TYPE_CHECKING:
    from quadtree_lss.replay.results import ScanTiming

Array = NDArray[np.float64]

UNSEEN, UNSEEN_COLOUR = 128, "#bbbbbb"
# Bit, name and colour of hazards, the first that applies is drawn (Okabe-Ito colours).
HAZARDS = (
    (UNSEEN, "unseen", UNSEEN_COLOUR),
    (1, "slope", "#d55e00"),
    (2, "elevation", "#cc79a7"),
    (4, "exception", "#56b4e9"),
    (8, "touchdown", "#e69f00"),
)
CLEAR_COLOUR = "#f0e9c8"  # no hazard
# Of where landing is allowed; the latter is no colour of a hazard nor of the absence of one.
SAFE_COLOUR, EXCLUDED_COLOUR = "#009e73", "#882255"
SITE_COLOUR = "#1c1c1c"  # of no map and no kind of hazard; ringed in white
NONE_COLOUR = "#cdcdcd"


def elevation_figure(cells: CellMap, assessment: LandingAssessment) -> Figure:
    """Elevation of the leaves' planes, with the edges of the leaves and the ranked sites."""
    domain = cells.domain
    figure, axes = _map_axes("Elevation of the planes, and the quadtree")
    extent = (domain.xmin, domain.xmin + domain.size, domain.ymin, domain.ymin + domain.size)
    heights = finest_elevation(cells)
    low, high = colour_limits(heights)
    image = axes.imshow(heights, origin="lower", extent=extent, cmap="viridis", vmin=low, vmax=high)
    width = float(np.clip(60.0 / np.sqrt(max(len(cells.level), 1)), 0.08, 0.6))
    axes.add_collection(
        LineCollection(list(leaf_edges(cells)), colors="black", linewidths=width, alpha=0.35)
    )
    _draw_sites(axes, assessment, radius=0.0)
    axes.set_facecolor(NONE_COLOUR)
    label = "elevation, m (grey: no estimate)"
    figure.colorbar(image, ax=axes, label=label, shrink=0.85, extend="both")
    _scale_bar(axes, domain.size)
    return figure


def slope_figure(assessment: LandingAssessment, config: Config) -> Figure:
    """Slope at the lander's scale; the tolerance is marked in the colour bar and as a contour."""
    figure, axes = _map_axes("Slope at the lander's scale")
    top = 2.0 * config.lss.max_slope_deg
    image = axes.imshow(
        assessment.slope_deg,
        origin="lower",
        extent=_grid_extent(assessment),
        cmap="cividis",
        vmin=0.0,
        vmax=top,
    )
    label = "slope, deg (grey: unseen)"
    bar = figure.colorbar(image, ax=axes, label=label, shrink=0.85, extend="max")
    bar.ax.axhline(config.lss.max_slope_deg, color="white")
    axes.set_facecolor(NONE_COLOUR)
    _scale_bar(axes, float(np.ptp(assessment.x)))
    if np.nanmax(assessment.slope_deg, initial=0.0) > config.lss.max_slope_deg:
        axes.contour(
            assessment.x,
            assessment.y,
            assessment.slope_deg,
            levels=[config.lss.max_slope_deg],
            colors="white",
            linewidths=0.8,
        )
    return figure


def hazard_figure(assessment: LandingAssessment, config: Config) -> Figure:
    """Kinds of hazards, and beside them where the vehicle may land, with the ranked sites."""
    note = f": {hazard_note(config)}" if hazard_note(config) else ""
    figure = Figure(figsize=(11.0, 6.4))
    left, right = figure.subplots(1, 2, sharey=True)
    figure.subplots_adjust(left=0.07, right=0.98, top=0.95, bottom=0.18, wspace=0.05)
    for axes, title in ((left, f"Hazards by kind{note}"), (right, "Where landing is allowed")):
        _label(axes, title)
        axes.title.set_size(10.5)  # the note is as long as the axes are wide
    right.set_ylabel("")
    kind = np.zeros(assessment.hazard.shape, dtype=np.int64)
    for place, (bit, _, _) in reversed(list(enumerate(HAZARDS, start=1))):
        kind[(assessment.hazard & bit) > 0] = place
    names = [("none", CLEAR_COLOUR), *((name, colour) for _, name, colour in HAZARDS)]
    kinds = _draw_classes(left, assessment, kind, names)
    _scale_bar(left, float(np.ptp(assessment.x)))
    unseen = (assessment.hazard & UNSEEN) > 0
    allowed = np.where(assessment.safe, 1, np.where(unseen, 2, 0))
    names = [("excluded", EXCLUDED_COLOUR), ("allowed", SAFE_COLOUR), ("unseen", UNSEEN_COLOUR)]
    decisions = _draw_classes(right, assessment, allowed, names)
    figure.legend(handles=kinds, loc="lower left", ncols=3, frameon=False)
    figure.legend(handles=decisions, loc="lower right", ncols=3, frameon=False)
    _draw_sites(right, assessment, radius=0.0)
    return figure


def hazard_note(config: Config) -> str:
    """Which kinds of hazards do not exclude landing, if any."""
    by_touchdown = config.lss.assessment == "touchdown"
    return "slope and elevation of leaves do not exclude" if by_touchdown else ""


def score_figure(assessment: LandingAssessment, config: Config) -> Figure:
    """Score of the landing zones (lower is better) with the ranked sites and their zones."""
    figure, axes = _map_axes("Landing site score (lower is better)")
    scores = assessment.score
    low, high = colour_limits(scores)
    image = axes.imshow(
        scores,
        origin="lower",
        extent=_grid_extent(assessment),
        cmap="viridis_r",
        vmin=low,
        vmax=high,
    )
    axes.set_facecolor(NONE_COLOUR)
    _scale_bar(axes, float(np.ptp(assessment.x)))
    _draw_sites(axes, assessment, 0.5 * config.lss.vehicle_diameter + config.lss.margin)
    figure.colorbar(image, ax=axes, label="score (grey: excluded)", shrink=0.85, extend="both")
    if not len(assessment.sites.score):
        axes.text(0.5, 0.5, "no safe site", transform=axes.transAxes, ha="center", size=18)
    return figure


def timing_figure(timings: Sequence[ScanTiming]) -> Figure:
    """Time of each map update, and the leaves after it."""
    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    axes = figure.add_subplot()
    stamps = np.array([row.stamp_ns for row in timings], dtype=np.int64)
    seconds = (stamps - stamps[0]) / 1e9
    times = np.array([row.map_ms for row in timings])
    axes.plot(seconds, times, ".-", color="#0072b2", linewidth=0.7, markersize=3)
    median = float(np.median(times))
    axes.axhline(median, color="#0072b2", linestyle="--", linewidth=0.8)
    axes.set_title(f"Map update: median {median:.2f} ms, worst {times.max():.2f} ms")
    axes.set_xlabel("time since the first scan, s")
    axes.set_ylabel("map update, ms", color="#0072b2")
    axes.set_ylim(bottom=0.0)
    other = axes.twinx()
    other.plot(seconds, [row.leaves for row in timings], color="#d55e00", linewidth=1.2)
    other.set_ylabel("leaves", color="#d55e00")
    other.set_ylim(bottom=0.0)
    return figure


def finest_elevation(cells: CellMap) -> Array:
    """(n, n) [iy, ix] elevation of the leaf planes at the centres of the finest cells, m."""
    domain = cells.domain
    row = cells.leaf_raster()
    centres = (np.arange(domain.finest_count) + 0.5) * domain.finest_size
    slope = -cells.normal[:, :2] / cells.normal[:, 2:]
    east = domain.xmin + centres[None, :] - cells.x[row]
    north = domain.ymin + centres[:, None] - cells.y[row]
    heights: Array = cells.z[row] + slope[row, 0] * east + slope[row, 1] * north
    return heights


def leaf_edges(cells: CellMap) -> Array:
    """(2 M, 2, 2) lines: the southern and western edge of each leaf, which draw each once."""
    half = 0.5 * cells.size
    west, south = cells.x - half, cells.y - half
    corner = np.column_stack([west, south])
    east_end = np.column_stack([west + cells.size, south])
    north_end = np.column_stack([west, south + cells.size])
    return np.concatenate(
        [np.stack([corner, east_end], axis=1), np.stack([corner, north_end], axis=1)]
    )


def colour_table(name: str) -> NDArray[np.uint8]:
    """(256, 3) colours of a matplotlib colour map."""
    colours = matplotlib.colormaps[name](np.arange(256), bytes=True)[:, :3]
    return np.ascontiguousarray(colours, dtype=np.uint8)


def _map_axes(title: str) -> tuple[Figure, Any]:
    figure = Figure(figsize=(8.0, 6.6), layout="constrained")
    axes = figure.add_subplot()
    _label(axes, title)
    return figure, axes


def _label(axes: Any, title: str) -> None:
    axes.set_title(title)
    axes.set_xlabel("x (map), m")
    axes.set_ylabel("y (map), m")
    axes.set_aspect("equal")


def _grid_extent(assessment: LandingAssessment) -> tuple[float, float, float, float]:
    """Nodes are points: the image reaches half a step beyond the outer ones."""
    x, y = assessment.x, assessment.y
    step = float(x[1] - x[0]) if len(x) > 1 else 1.0
    return (x[0] - step / 2, x[-1] + step / 2, y[0] - step / 2, y[-1] + step / 2)


def colour_limits(values: Array) -> tuple[float, float]:
    """Range of a colour map that a few outliers do not stretch: 0.5 and 99.5 %."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = np.percentile(finite, [0.5, 99.5])
    return float(low), float(high) if high > low else float(low) + 1e-6


def _scale_bar(axes: Any, width: float) -> None:
    """A bar of about a fifth of the map's width (m), 1, 2 or 5 times a power of ten long."""
    about = 0.2 * width
    power = 10.0 ** np.floor(np.log10(about))
    length = power * max(m for m in (1.0, 2.0, 5.0) if m * power <= about)
    bar = AnchoredSizeBar(axes.transData, length, f"{length:g} m", "lower left", pad=0.4)
    bar.patch.set_alpha(0.85)
    axes.add_artist(bar)


def _draw_sites(axes: Any, assessment: LandingAssessment, radius: float) -> None:
    for rank, (x, y, _) in enumerate(assessment.sites.position, start=1):
        if radius > 0.0:
            axes.add_patch(Circle((x, y), radius, fill=False, color="white", linewidth=2.6))
            axes.add_patch(Circle((x, y), radius, fill=False, color=SITE_COLOUR, linewidth=1.2))
        axes.annotate(
            str(rank),
            (x, y),
            color="white",
            size=8,
            ha="center",
            va="center",
            bbox={"boxstyle": "circle,pad=0.2", "facecolor": SITE_COLOUR, "edgecolor": "white"},
        )


def _draw_classes(
    axes: Any,
    assessment: LandingAssessment,
    kind: NDArray[np.int64],
    classes: Sequence[tuple[str, str]],
) -> list[Patch]:
    """Image of class numbers; the answer is a legend of the classes and their shares."""
    colours = [colour for _, colour in classes]
    axes.imshow(
        kind,
        origin="lower",
        extent=_grid_extent(assessment),
        cmap=ListedColormap(colours),
        norm=BoundaryNorm(np.arange(-0.5, len(colours)), len(colours)),
        interpolation="nearest",
    )
    return [
        Patch(
            facecolor=colour,
            edgecolor="black",
            linewidth=0.4,
            label=f"{name} {100.0 * np.mean(kind == number):.1f} %",
        )
        for number, (name, colour) in enumerate(classes)
    ]
