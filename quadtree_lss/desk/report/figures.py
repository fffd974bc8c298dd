# SPDX-License-Identifier: Apache-2.0
"""Figures of a results folder, for print and for browsers without JavaScript."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from quadtree_lss.desk.exchange.saved import Results
from quadtree_lss.desk.report import drawing, palette
from quadtree_lss.onboard.arrays import Array

NO_VALUE_COLOUR = "#cdcdcd"


def figures(content: Results) -> dict[str, Figure]:
    """Draw all figures; return them by name."""
    grid, zone = content.grid, content.zone
    found = {"hazards": hazard_figure(content)}
    found["elevation"], axes = _map("Elevation of the map's planes", content)
    _layer(axes, content, grid["elevation"], "elevation", "elevation, m")
    drawing.mark_sites(axes, content.positions)
    found["score"], axes = _map("Landing site score (lower is better)", content)
    _layer(axes, content, grid["score"], "score", "score (grey: excluded)")
    drawing.mark_sites(axes, content.positions, zone)
    if content.probability is not None:
        title = "Probability of a safe touchdown if aimed here"
        found["probability"], axes = _map(title, content)
        percent, limits = 100.0 * content.probability, (0.0, 100.0)
        _layer(axes, content, percent, "probability", "probability, %", limits=limits)
        drawing.mark_sites(axes, content.positions, zone)
    return found


def hazard_figure(content: Results) -> Figure:
    """Draw the kinds of hazards, as outlines if they do not exclude landing, and beside them the
    allowed ground with the ranked sites."""
    figure = Figure(figsize=(11.0, 6.7))
    left, right = figure.subplots(1, 2, sharey=True)
    figure.subplots_adjust(left=0.07, right=0.98, top=0.96, bottom=0.21, wspace=0.05)
    for axes, title in ((left, "Hazards by kind"), (right, "Where landing is allowed")):
        drawing.map_axes(axes, title, _box(content))
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
    drawing.mark_sites(right, content.positions, content.zone)
    return figure


def _map(title: str, content: Results) -> tuple[Figure, Any]:
    figure = Figure(figsize=(8.0, 6.6), layout="constrained")
    axes = figure.add_subplot()
    drawing.map_axes(axes, title, _box(content))
    return figure, axes


def _layer(axes: Any, content: Results, values: Array, kind: str, label: str, **style: Any) -> Any:
    """Draw values (ny, nx) with the relief of the map; return the colour bar."""
    grid = content.grid
    style |= {"heights": grid["elevation"], "unknown": NO_VALUE_COLOUR}
    drawn = drawing.layer(axes, grid.x, grid.y, values, kind, **style)
    label += "" if "grey" in label else " (grey: unobserved)"
    return axes.figure.colorbar(drawn, ax=axes, label=label, shrink=0.85, extend="both")


def _box(content: Results) -> drawing.Box:
    """Box of the observed ground, or of the grid if nothing was observed."""
    grid = content.grid
    if not grid.seen.any():
        return drawing.extent(grid.x, grid.y)
    x, y = grid.x[grid.seen.any(axis=0)], grid.y[grid.seen.any(axis=1)]
    room = 2.0 * grid.spacing
    return x[0] - room, x[-1] + room, y[0] - room, y[-1] + room


def _classes(axes: Any, content: Results, kind: Any, names: list[tuple[str, str]]) -> list[Patch]:
    """Draw class numbers with the relief of the map; return legend entries with the shares of the
    observed ground."""
    grid, colours = content.grid, [colour for _, colour in names]
    drawing.classes(axes, grid.x, grid.y, kind, colours, grid["elevation"])
    seen = max(np.count_nonzero(grid.seen), 1)
    legend = []
    for number, (name, colour) in enumerate(names):
        share = 100.0 * np.count_nonzero((kind == number) & grid.seen) / seen
        label = name if name in ("unobserved", palette.UNMAPPED_NAME) else f"{name} {share:.1f} %"
        if name != palette.UNMAPPED_NAME or grid.unmapped.any():
            legend.append(Patch(facecolor=colour, edgecolor="black", linewidth=0.4, label=label))
    return legend
