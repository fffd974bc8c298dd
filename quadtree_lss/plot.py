# SPDX-License-Identifier: Apache-2.0
"""Plots of maps, landing grids, sites and profiles on the caller's matplotlib axes.

    figure, axes = plt.subplots()
    plot.elevation(axes, results.map)
    plot.sites(axes, results.positions, radius=1.85)

Each function returns the artist, for instance for a colour bar.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from quadtree_lss.desk.report.drawing import extent, outline
from quadtree_lss.desk.report.drawing import mark_sites as sites
from quadtree_lss.desk.report.palette import (
    CLEAR_COLOUR,
    HAZARDS,
    KINDS,
    MAPS,
    colour_limits,
    gradients,
)
from quadtree_lss.onboard.arrays import Array, Bytes
from quadtree_lss.onboard.core.tree.cell_map import CellMap, Profile

__all__ = ["elevation", "layer", "profile", "relief", "sites"]
UNITS = {"elevation": "m", "plane_elevation": "m", "slope_deg": "deg"}


def elevation(
    axes: Any, cells: CellMap, *, hillshade: bool = True, edges: bool = False, **image: Any
) -> Any:
    """Plot the heights of a map's planes.

    Args:
        axes: Matplotlib axes.
        cells: The map.
        hillshade: Shade the ground with light from the north-west.
        edges: Draw the edges of the leaves.
        image: Options of ``imshow``.

    Returns:
        The image of the heights, without the shading.
    """
    domain = cells.domain
    middles = (np.arange(domain.finest_count) + 0.5) * domain.finest_size
    heights = cells.at(domain.xmin + middles, (domain.ymin + middles)[:, None]).height
    box = (domain.xmin, domain.xmin + domain.size, domain.ymin, domain.ymin + domain.size)
    low, high = colour_limits(heights)
    options = {"origin": "lower", "extent": box, "vmin": low, "vmax": high}
    options["cmap"] = MAPS["elevation"]
    drawn = axes.imshow(heights, **(options | image))
    if hillshade:
        shade, strength = relief(heights, domain.finest_size), 0.65
        dark = np.zeros((*heights.shape, 4))
        dark[..., :3] = (shade > 0.5)[..., None]
        dark[..., 3] = strength * np.nan_to_num(np.abs(2.0 * shade - 1.0))
        axes.imshow(dark, origin="lower", extent=box)
    if edges:
        outline(axes, cells, linewidths=0.2)
    _label(axes)
    return drawn


def relief(heights: Array, side: float, *, sun_deg: tuple[float, float] = (315.0, 40.0)) -> Array:
    """Compute the hillshade of heights (ny, nx): 0 dark to 1, level ground 0.5, NaN where unknown.
    ``side``: spacing of the heights, m. ``sun_deg``: azimuth clockwise from north (y), and
    elevation."""
    north, east = gradients(heights, side)
    azimuth, up = np.radians(sun_deg)
    towards = -(east * np.sin(azimuth) + north * np.cos(azimuth)) * np.cos(up)
    light = (towards + np.sin(up)) / np.sqrt(1.0 + east**2 + north**2)
    return np.asarray(np.clip(0.5 + 0.9 * (light - np.sin(up)), 0.0, 1.0))


def layer(axes: Any, grid: Any, name: str, **image: Any) -> Any:
    """Plot one layer of a landing grid, such as ``slope_deg`` or ``score``.

    Args:
        axes: Matplotlib axes.
        grid: ``results.grid``, or ``assessment`` of a replay.
        name: Name of the layer.
        image: Options of ``imshow``.

    Raises:
        KeyError, AttributeError: there is no such layer.
    """
    values = grid.layers[name] if hasattr(grid, "layers") else getattr(grid, name)
    if name == "hazard":
        drawn = _hazards(axes, grid, values)
    else:
        low, high = colour_limits(np.asarray(values, np.float64))
        options = {"cmap": MAPS.get(KINDS.get(name, name), "viridis"), "vmin": low, "vmax": high}
        drawn = axes.imshow(
            values, origin="lower", extent=extent(grid.x, grid.y), **(options | image)
        )
    axes.set_title(name + (f", {UNITS[name]}" if name in UNITS else ""))
    _label(axes)
    return drawn


def profile(axes: Any, along: Profile, *, sigmas: float = 3.0, **line: Any) -> Any:
    """Plot heights along a line with a band of ``sigmas`` standard deviations."""
    (drawn,) = axes.plot(along.distance, along.height, **line)
    band = sigmas * along.deviation
    axes.fill_between(
        along.distance,
        along.height - band,
        along.height + band,
        color=drawn.get_color(),
        alpha=0.25,
        linewidth=0,
        label=f"± {sigmas:g} standard deviations",
    )
    axes.set_xlabel("distance, m")
    axes.set_ylabel("height, m")
    return drawn


def _hazards(axes: Any, grid: Any, bits: Bytes) -> Any:
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch

    kind = np.zeros(bits.shape, dtype=np.int64)
    for number, (bit, _, _) in reversed(list(enumerate(HAZARDS, start=1))):
        kind[(bits & bit) > 0] = number
    colours = [CLEAR_COLOUR, *(colour for _, _, colour in HAZARDS)]
    norm = BoundaryNorm(np.arange(-0.5, len(colours)), len(colours))
    shown = {"cmap": ListedColormap(colours), "norm": norm, "interpolation": "nearest"}
    names = ["none", *(name for _, name, _ in HAZARDS)]
    drawn = [Patch(facecolor=colours[k], label=names[k]) for k in np.unique(kind)]
    axes.legend(handles=drawn, fontsize="x-small")
    return axes.imshow(kind, origin="lower", extent=extent(grid.x, grid.y), **shown)


def _label(axes: Any) -> None:
    axes.set_xlabel("x (map), m")
    axes.set_ylabel("y (map), m")
    axes.set_aspect("equal")
