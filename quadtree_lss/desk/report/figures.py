# SPDX-License-Identifier: Apache-2.0
"""Figures of a results folder, for print and for browsers without JavaScript, and their parts."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar  # type: ignore[import-untyped]
from numpy.typing import ArrayLike

from quadtree_lss.desk.exchange.saved import Results
from quadtree_lss.desk.report import palette
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.tree.cell_map import CellMap

NO_VALUE_COLOUR = "#cdcdcd"
Box = tuple[float, float, float, float]
"""xmin, xmax, ymin, ymax; m."""


def extent(x: Array, y: Array) -> Box:
    """Box of an image with samples at x (nx,), y (ny,), including half a step at each edge."""
    dx, dy = 0.5 * _step(x), 0.5 * _step(y)
    return x[0] - dx, x[-1] + dx, y[0] - dy, y[-1] + dy


def _step(axis: Array) -> float:
    return float(axis[1] - axis[0]) if len(axis) > 1 else 1.0


def image(axes: Any, x: Array, y: Array, colours: Array) -> None:
    """Draw colours (ny, nx, 3) with samples at x, y; keep the limits of the axes."""
    limits = axes.get_xlim(), axes.get_ylim()
    axes.imshow(colours, extent=extent(x, y), interpolation="nearest", origin="lower")
    axes.set(xlim=limits[0], ylim=limits[1])


def classes(axes: Any, x: Array, y: Array, kind: Any, colours: Any, heights: Array) -> None:
    """Draw class numbers (ny, nx) in their colours, with a relief of ``heights``."""
    drawn = ListedColormap(colours)(np.asarray(kind, dtype=np.int64))[..., :3]
    image(axes, x, y, palette.shaded(drawn, heights, _step(x), 0.6))


def layer(
    axes: Any,
    x: Array,
    y: Array,
    values: Array,
    kind: str = "elevation",
    limits: tuple[float, float] | None = None,
    *,
    heights: Array | None = None,
    unknown: str = "white",
) -> ScalarMappable:
    """Draw values (ny, nx) with a colour map of `palette.MAPS` and a relief of ``heights``, by
    default the values. Return the mappable for a colour bar."""
    norm = Normalize(*(limits or palette.colour_limits(values)))
    colours = matplotlib.colormaps[palette.MAPS[kind]].with_extremes(bad=unknown)
    drawn = colours(norm(np.ma.masked_invalid(values)))[..., :3]
    strength = 0.75 if kind == "elevation" else 0.4
    ground = values if heights is None else heights
    image(axes, x, y, palette.shaded(drawn, ground, _step(x), strength))
    return ScalarMappable(norm, colours)


def map_axes(axes: Any, title: str, box: Box) -> None:
    """Set up axes of equal scale in metres with a scale bar."""
    axes.set(xlabel="x (map), m", ylabel="y (map), m", aspect="equal")
    axes.set(xlim=box[:2], ylim=box[2:])
    axes.set_title(title, fontsize="medium")
    approximate_length = 0.2 * (box[1] - box[0])
    power = 10.0 ** np.floor(np.log10(approximate_length))
    length = power * max(
        m for m in (1.0, 2.0, 5.0) if m * power <= approximate_length * (1.0 + 1e-9)
    )
    bar = AnchoredSizeBar(axes.transData, length, f"{length:g} m", "lower left", pad=0.4)
    bar.patch.set_alpha(0.85)
    bar.set_zorder(9)
    axes.add_artist(bar)


def mark_sites(axes: Any, places: ArrayLike, radius: float = 0.0) -> list[Any]:
    """Mark ranked sites (K, 2 or 3) with their ranks and circles of ``radius`` m."""
    drawn = []
    for rank, (x, y, *_) in enumerate(np.asarray(places, np.float64), start=1):
        if radius > 0.0:
            axes.add_patch(Circle((x, y), radius, fill=False, color="white", linewidth=2.6))
            ring = Circle((x, y), radius, fill=False, color=palette.SITE_COLOUR, linewidth=1.2)
            axes.add_patch(ring)
        box = {"boxstyle": "circle,pad=0.2", "facecolor": palette.SITE_COLOUR, "edgecolor": "white"}
        text = {"color": "white", "size": 8, "ha": "center", "va": "center", "bbox": box}
        drawn.append(axes.annotate(str(rank), (x, y), annotation_clip=True, **text))
    return drawn


def outline(axes: Any, cells: CellMap, **style: Any) -> None:
    """Draw the boundaries of leaves."""
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]], float)
    centre = np.stack([cells.x, cells.y], axis=-1)
    edges = centre[:, None, :] + 0.5 * cells.size[:, None, None] * corner
    width = float(np.clip(30.0 / np.sqrt(max(cells.level.size, 1)), 0.15, 0.6))
    style = {"colors": "black", "linewidths": width, **style}
    axes.add_collection(LineCollection(list(edges), **style))


def png(figure: Figure, dpi: int = 130) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    return content.getvalue()


def figures(content: Results) -> dict[str, Figure]:
    """Draw all figures; return them by name."""
    found = {"hazards": hazard_figure(content)}
    shown = [
        ("elevation", "Elevation of the map's planes", "elevation, m"),
        ("score", "Landing site score (lower is better)", "score (grey: excluded)"),
        ("probability", "Probability of a safe touchdown if aimed here", "probability, %"),
    ]
    for name, title, label in shown if content.probability is not None else shown[:2]:
        found[name] = figure = Figure(figsize=(8.0, 6.6), layout="constrained")
        axes = figure.add_subplot()
        map_axes(axes, title, _box(content))
        in_percent = name == "probability"
        values = content.grid[name] * (100.0 if in_percent else 1.0)
        _layer(axes, content, values, name, label, limits=(0.0, 100.0) if in_percent else None)
        mark_sites(axes, content.positions, 0.0 if name == "elevation" else content.zone)
    return found


def hazard_figure(content: Results) -> Figure:
    """Draw the kinds of hazards, as outlines if they do not exclude landing, and beside them the
    allowed ground with the ranked sites."""
    figure = Figure(figsize=(11.0, 6.7))
    left, right = figure.subplots(1, 2, sharey=True)
    figure.subplots_adjust(left=0.07, right=0.98, top=0.96, bottom=0.21, wspace=0.05)
    for axes, title in ((left, "Hazards by kind"), (right, "Where landing is allowed")):
        map_axes(axes, title, _box(content))
    right.set_ylabel("")
    grid = content.grid
    bits = palette.excluding(content.config.lss.assessment)
    filled = [row for row in palette.HAZARDS if row[0] & (bits | palette.UNKNOWN)]
    kind = palette.hazard_classes(grid["hazard"], filled)
    names = [("none", palette.CLEAR_COLOUR), *((name, colour) for _, name, colour in filled)]
    kinds = _classes(left, content, kind, names)
    for bit, name, colour in palette.HAZARDS:
        shown = ((grid["hazard"] & bit) > 0) & content.grid.seen
        if not (bits | palette.UNKNOWN) & bit and shown.any():
            if not shown.all():  # otherwise it has no outline
                left.contour(grid["x"], grid["y"], shown, [0.5], colors=colour, linewidths=0.7)
            kinds.append(Patch(facecolor="none", edgecolor=colour, label=f"{name}, not excluding"))
    unseen = np.where(grid.unmapped, 3, 2)
    allowed = np.where(grid["safe"], 1, np.where(grid.seen, 0, unseen))
    names = [("excluded", palette.EXCLUDED_COLOUR), ("allowed", palette.SAFE_COLOUR)]
    names += [(name, colour) for _, name, colour in palette.HAZARDS[1::-1]]
    decisions = _classes(right, content, allowed, names)
    for axes, handles in ((left, kinds), (right, decisions)):
        layout = {"ncols": 2, "columnspacing": 1.0, "fontsize": "small", "frameon": False}
        axes.legend(handles=handles, loc="upper left", bbox_to_anchor=(-0.02, -0.1), **layout)
    mark_sites(right, content.positions, content.zone)
    return figure


def _layer(axes: Any, content: Results, values: Array, kind: str, label: str, **style: Any) -> Any:
    """Draw values (ny, nx) with the relief of the map; return the colour bar."""
    grid = content.grid
    style |= {"heights": grid["elevation"], "unknown": NO_VALUE_COLOUR}
    drawn = layer(axes, grid.x, grid.y, values, kind, **style)
    label += "" if "grey" in label else " (grey: unobserved)"
    return axes.figure.colorbar(drawn, ax=axes, label=label, shrink=0.85, extend="both")


def _box(content: Results) -> Box:
    """Box of the observed ground, or of the grid if nothing was observed."""
    grid = content.grid
    if not grid.seen.any():
        return extent(grid.x, grid.y)
    x, y = grid.x[grid.seen.any(axis=0)], grid.y[grid.seen.any(axis=1)]
    room = 2.0 * grid.spacing
    return x[0] - room, x[-1] + room, y[0] - room, y[-1] + room


def _classes(axes: Any, content: Results, kind: Any, names: list[tuple[str, str]]) -> list[Patch]:
    """Draw class numbers with the relief of the map; return legend entries with the shares of the
    observed ground."""
    grid, colours = content.grid, [colour for _, colour in names]
    classes(axes, grid.x, grid.y, kind, colours, grid["elevation"])
    seen = max(np.count_nonzero(grid.seen), 1)
    legend = []
    for number, (name, colour) in enumerate(names):
        share = 100.0 * np.count_nonzero((kind == number) & grid.seen) / seen
        label = name if name in ("unobserved", palette.UNMAPPED_NAME) else f"{name} {share:.1f} %"
        if name != palette.UNMAPPED_NAME or grid.unmapped.any():
            legend.append(Patch(facecolor=colour, edgecolor="black", linewidth=0.4, label=label))
    return legend
