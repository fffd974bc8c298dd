# SPDX-License-Identifier: Apache-2.0
"""Plots of maps, landing grids, sites and profiles on the caller's matplotlib axes.

    figure, axes = plt.subplots()
    plot.elevation(axes, results.map)
    plot.sites(axes, results.positions, radius=1.85)

Each function returns what it has drawn, for instance for a colour bar.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.patches import Patch
from numpy.typing import ArrayLike

from quadtree_lss.desk.report import figures
from quadtree_lss.desk.report.figures import mark_sites as sites
from quadtree_lss.desk.report.palette import CLEAR_COLOUR, HAZARDS, KINDS, MAPS, hazard_classes
from quadtree_lss.onboard.core.tree.cell_map import CellMap

__all__ = ["elevation", "layer", "profile", "sites"]
UNITS = {"elevation": "m", "plane_elevation": "m", "slope_deg": "deg"}


def elevation(axes: Any, cells: CellMap, *, edges: bool = False) -> Any:
    """Plot the heights of a map's planes in relief. ``edges``: draw the edges of the leaves."""
    domain = cells.domain
    middles = (np.arange(domain.finest_count) + 0.5) * domain.finest_size
    x, y = domain.xmin + middles, domain.ymin + middles
    figures.map_axes(axes, "elevation, m", figures.extent(x, y))
    if edges:
        figures.outline(axes, cells, linewidths=0.2)
    return figures.layer(axes, x, y, cells.at(x, y[:, None]).height)


def layer(axes: Any, grid: Any, name: str) -> Any:
    """Plot one layer of a landing grid, such as ``slope_deg`` or ``score``, in relief.

    ``grid``: ``results.grid``, or ``assessment`` of a replay. Raises KeyError or AttributeError:
    there is no such layer.
    """
    layers = grid.layers if hasattr(grid, "layers") else vars(grid)
    values, heights = layers[name], layers["elevation"]
    title = name + (f", {UNITS[name]}" if name in UNITS else "")
    figures.map_axes(axes, title, figures.extent(grid.x, grid.y))
    if name == "hazard":
        kinds = hazard_classes(values, HAZARDS)
        classes = [("none", CLEAR_COLOUR), *((text, colour) for _, text, colour in HAZARDS)]
        colours = [colour for _, colour in classes]
        figures.classes(axes, grid.x, grid.y, kinds, colours, heights)
        shown = [classes[k] for k in np.unique(kinds)]
        handles = [Patch(facecolor=colour, label=text) for text, colour in shown]
        return axes.legend(handles=handles, fontsize="x-small")
    kind = KINDS.get(name, name)
    kind = kind if kind in MAPS else "probability"
    return figures.layer(axes, grid.x, grid.y, np.asarray(values, float), kind, heights=heights)


def profile(
    axes: Any, cells: CellMap, start: ArrayLike, end: ArrayLike, *, sigmas: float = 3.0, **line: Any
) -> Any:
    """Plot the heights of a map along the straight line between two points (x, y), m, sampled
    twice in each finest cell, with a band of ``sigmas`` standard deviations."""
    first, last = np.asarray(start, np.float64), np.asarray(end, np.float64)
    length = float(np.hypot(*(last - first)))
    share = np.linspace(0.0, 1.0, int(np.ceil(2.0 * length / cells.domain.finest_size)) + 1)
    ground = cells.at(*(first + share[:, None] * (last - first)).T)
    (drawn,) = axes.plot(length * share, ground.height, **line)
    band = sigmas * ground.deviation
    style = {"color": drawn.get_color(), "alpha": 0.25, "linewidth": 0}
    label = f"± {sigmas:g} standard deviations"
    low, high = ground.height - band, ground.height + band
    axes.fill_between(length * share, low, high, label=label, **style)
    axes.set(xlabel="distance, m", ylabel="height, m")
    return drawn
