# SPDX-License-Identifier: Apache-2.0
"""Figures of a results folder; each function returns a matplotlib figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.colors import BoundaryNorm, ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar  # type: ignore[import-untyped]
from numpy.typing import NDArray

from quadtree_lss.desk.report.content import Content
from quadtree_lss.desk.report.palette import (
    CLEAR_COLOUR,
    EXCLUDED_COLOUR,
    HAZARDS,
    MAPS,
    SAFE_COLOUR,
    SITE_COLOUR,
    UNKNOWN,
    UNMAPPED_COLOUR,
    UNMAPPED_NAME,
    UNSEEN_COLOUR,
    colour_limits,
    excluding,
    shaded,
    slope_limit,
    top_limit,
)
from quadtree_lss.onboard.arrays import Array

NONE_COLOUR = "#cdcdcd"


def elevation_figure(content: Content) -> Figure:
    """Elevation of the map's own planes, hillshaded, with the ranked sites."""
    figure, axes = _map_axes("Elevation of the map's planes", content)
    _draw(figure, axes, content, content.grid["elevation"], "elevation", "elevation, m")
    _draw_sites(axes, content, radius=0.0)
    return figure


def slope_figure(content: Content) -> Figure:
    """Slope at the lander's scale; the tolerance is marked in the colour bar and as a contour."""
    figure, axes = _map_axes("Slope at the lander's scale", content)
    grid, limit = content.grid, slope_limit(content.config.lss)
    top = max(top_limit(grid["slope_deg"])[1], limit)
    label = f"slope, deg (limit {limit:g} in white; grey: unseen)"
    bar = _draw(figure, axes, content, grid["slope_deg"], "slope", label, (0.0, top))
    bar.ax.axhline(limit, color="white")
    if np.nanmax(grid["slope_deg"], initial=0.0) > limit:
        axes.contour(
            grid["x"], grid["y"], grid["slope_deg"], [limit], colors="white", linewidths=0.8
        )
    return figure


def hazard_figure(content: Content) -> Figure:
    """Kinds of hazards, and beside them where the vehicle may land, with the ranked sites.

    Kinds that do not exclude landing are outlines.
    """
    figure = Figure(figsize=(11.0, 6.4))
    left, right = figure.subplots(1, 2, sharey=True)
    figure.subplots_adjust(left=0.07, right=0.98, top=0.95, bottom=0.18, wspace=0.05)
    for axes, title in ((left, "Hazards by kind"), (right, "Where landing is allowed")):
        _label(axes, title, content)
    right.set_ylabel("")
    grid = content.grid
    bits = excluding(content.config.lss.assessment)
    filled = [row for row in HAZARDS if row[0] & (bits | UNKNOWN)]
    kind = np.zeros(grid["hazard"].shape, dtype=np.int64)
    for place, (bit, _, _) in reversed(list(enumerate(filled, start=1))):
        kind[(grid["hazard"] & bit) > 0] = place
    names = [("none", CLEAR_COLOUR), *((name, colour) for _, name, colour in filled)]
    kinds = _draw_classes(left, content, kind, names)
    for bit, name, colour in HAZARDS:
        shown = ((grid["hazard"] & bit) > 0) & content.seen
        if not (bits | UNKNOWN) & bit and shown.any():
            left.contour(grid["x"], grid["y"], shown, [0.5], colors=colour, linewidths=0.7)
            kinds.append(Patch(facecolor="none", edgecolor=colour, label=f"{name}, not excluding"))
    allowed = np.where(grid["safe"], 1, np.where(content.seen, 0, np.where(content.unmapped, 3, 2)))
    names = [("excluded", EXCLUDED_COLOUR), ("allowed", SAFE_COLOUR), ("unseen", UNSEEN_COLOUR)]
    names += [(UNMAPPED_NAME, UNMAPPED_COLOUR)]
    decisions = _draw_classes(right, content, allowed, names)
    figure.legend(handles=kinds, loc="lower left", ncols=3, frameon=False)
    figure.legend(handles=decisions, loc="lower right", ncols=3, frameon=False)
    _draw_sites(right, content, radius=content.zone)
    return figure


def probability_figure(content: Content) -> Figure:
    """Probability of a safe touchdown for each aim, with the ranked sites and their zones."""
    figure, axes = _map_axes("Probability of a safe touchdown if aimed here", content)
    share = content.grid["probability"]
    _draw(figure, axes, content, 100.0 * share, "probability", "probability, %", (0.0, 100.0))
    _draw_sites(axes, content, content.zone)
    return figure


def score_figure(content: Content) -> Figure:
    """Score of the landing zones (lower is better) with the ranked sites and their zones."""
    figure, axes = _map_axes("Landing site score (lower is better)", content)
    _draw(figure, axes, content, content.grid["score"], "score", "score (grey: excluded)")
    _draw_sites(axes, content, content.zone)
    if not len(content.sites["x"]):
        axes.text(0.5, 0.5, "no safe site", transform=axes.transAxes, ha="center", size=18)
    return figure


def timing_figure(content: Content) -> Figure:
    """Time of each map update, and the leaves after it."""
    figure = Figure(figsize=(9.0, 3.8), layout="constrained")
    axes = figure.add_subplot()
    stamps, times = content.timing["stamp_ns"], content.timing["map_ms"]
    seconds = (stamps - stamps[0]) / 1e9
    axes.plot(seconds, times, ".-", color="#0072b2", linewidth=0.7, markersize=3)
    median = float(np.median(times))
    axes.axhline(median, color="#0072b2", linestyle="--", linewidth=0.8)
    axes.set_title(f"Map update: median {median:.2f} ms, worst {times.max():.2f} ms")
    axes.set_xlabel("time since the first scan, s")
    axes.set_ylabel("map update, ms", color="#0072b2")
    axes.set_ylim(bottom=0.0)
    other = axes.twinx()
    other.plot(seconds, content.timing["leaves"], color="#d55e00", linewidth=1.2)
    other.set_ylabel("leaves", color="#d55e00")
    other.set_ylim(bottom=0.0)
    return figure


def _draw(
    figure: Figure,
    axes: Any,
    content: Content,
    values: Array,
    kind: str,
    label: str,
    limits: tuple[float, float] | None = None,
) -> Any:
    """Values (ny, nx) on the shaded ground; the answer is their colour bar."""
    norm = Normalize(*(limits or colour_limits(values)))
    colours = matplotlib.colormaps[MAPS[kind]].with_extremes(bad=NONE_COLOUR)
    image = colours(norm(np.ma.masked_invalid(values)))[..., :3]
    strength = 0.75 if kind == "elevation" else 0.4
    image = shaded(image, content.grid["elevation"], content.spacing, strength)
    axes.imshow(image, origin="lower", extent=_extent(content))
    scale = matplotlib.cm.ScalarMappable(norm, colours)
    if "grey" not in label:
        label += " (grey: unseen)"
    _scale_bar(axes, content)
    return figure.colorbar(scale, ax=axes, label=label, shrink=0.85, extend="both")


def _map_axes(title: str, content: Content) -> tuple[Figure, Any]:
    figure = Figure(figsize=(8.0, 6.6), layout="constrained")
    axes = figure.add_subplot()
    _label(axes, title, content)
    return figure, axes


def _label(axes: Any, title: str, content: Content) -> None:
    """Axes in metres that show the seen ground."""
    axes.set_title(title)
    axes.set_xlabel("x (map), m")
    axes.set_ylabel("y (map), m")
    axes.set_aspect("equal")
    axes.set_autoscale_on(False)
    west, east, south, north = _extent(content)
    if content.seen.any():
        x = content.grid["x"][content.seen.any(axis=0)]
        y = content.grid["y"][content.seen.any(axis=1)]
        room = 2.0 * content.spacing
        west, east, south, north = x[0] - room, x[-1] + room, y[0] - room, y[-1] + room
    axes.set_xlim(west, east)
    axes.set_ylim(south, north)


def _extent(content: Content) -> tuple[float, float, float, float]:
    """Grid points are points: the image reaches half a step beyond the outer ones."""
    x, y, half = content.grid["x"], content.grid["y"], 0.5 * content.spacing
    return (x[0] - half, x[-1] + half, y[0] - half, y[-1] + half)


def _scale_bar(axes: Any, content: Content) -> None:
    """A bar of about a fifth of the width, 1, 2 or 5 times a power of ten long."""
    about = 0.2 * float(np.ptp(axes.get_xlim()))
    power = 10.0 ** np.floor(np.log10(about))
    length = power * max(m for m in (1.0, 2.0, 5.0) if m * power <= about)
    bar = AnchoredSizeBar(axes.transData, length, f"{length:g} m", "lower left", pad=0.4)
    bar.patch.set_alpha(0.85)
    axes.add_artist(bar)


def _draw_sites(axes: Any, content: Content, radius: float) -> None:
    places = zip(content.sites["x"], content.sites["y"], strict=True)
    for rank, (x, y) in enumerate(places, start=1):
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
    axes: Any, content: Content, kind: NDArray[np.int64], classes: Sequence[tuple[str, str]]
) -> list[Patch]:
    """Image of class numbers on the shaded ground; the answer is a legend with their shares of
    the seen ground."""
    colours = [colour for _, colour in classes]
    drawn = ListedColormap(colours)(BoundaryNorm(np.arange(-0.5, len(colours)), len(colours))(kind))
    image = shaded(drawn[..., :3], content.grid["elevation"], content.spacing, 0.6)
    axes.imshow(image, origin="lower", extent=_extent(content), interpolation="nearest")
    _scale_bar(axes, content)
    seen = max(np.count_nonzero(content.seen), 1)
    return [
        Patch(
            facecolor=colour,
            edgecolor="black",
            linewidth=0.4,
            label=name
            if name in ("unseen", UNMAPPED_NAME)
            else f"{name} {100.0 * np.count_nonzero((kind == number) & content.seen) / seen:.1f} %",
        )
        for number, (name, colour) in enumerate(classes)
        if name != UNMAPPED_NAME or content.unmapped.any()
    ]
