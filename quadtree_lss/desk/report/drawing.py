# SPDX-License-Identifier: Apache-2.0
"""Parts of figures: images of grids, shaded relief, scale bars, markers of sites."""

from __future__ import annotations

import io
from typing import Any

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar  # type: ignore[import-untyped]
from numpy.typing import ArrayLike

from quadtree_lss.desk.report.palette import MAPS, SITE_COLOUR, colour_limits, shaded
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.tree.cell_map import CellMap

Box = tuple[float, float, float, float]
"""xmin, xmax, ymin, ymax; m."""


def extent(x: Array, y: Array) -> Box:
    """Box of an image with samples at x (nx,), y (ny,), including half a step at each edge."""
    dx, dy = 0.5 * _step(x), 0.5 * _step(y)
    return x[0] - dx, x[-1] + dx, y[0] - dy, y[-1] + dy


def _step(axis: Array) -> float:
    return float(axis[1] - axis[0]) if len(axis) > 1 else 1.0


def image(axes: Any, x: Array, y: Array, values: Any, **style: Any) -> Any:
    """Draw an array (ny, nx) with samples at x, y; keep the limits of the axes."""
    limits = axes.get_xlim(), axes.get_ylim()
    style = {"interpolation": "nearest", "origin": "lower", **style}
    drawn = axes.imshow(values, extent=extent(x, y), **style)
    axes.set(xlim=limits[0], ylim=limits[1])
    return drawn


def classes(
    axes: Any, x: Array, y: Array, kind: Any, colours: Any, heights: Array | None = None
) -> None:
    """Draw class numbers (ny, nx) in their colours, with a relief of ``heights`` if given."""
    drawn = ListedColormap(colours)(np.asarray(kind, dtype=np.int64))[..., :3]
    if heights is not None:
        drawn = shaded(drawn, heights, _step(x), 0.6)
    image(axes, x, y, drawn)


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
    norm = Normalize(*(limits or colour_limits(values)))
    colours = matplotlib.colormaps[MAPS[kind]].with_extremes(bad=unknown)
    drawn = colours(norm(np.ma.masked_invalid(values)))[..., :3]
    strength = 0.75 if kind == "elevation" else 0.4
    ground = values if heights is None else heights
    image(axes, x, y, shaded(drawn, ground, _step(x), strength))
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
            ring = Circle((x, y), radius, fill=False, color=SITE_COLOUR, linewidth=1.2)
            axes.add_patch(ring)
        box = {"boxstyle": "circle,pad=0.2", "facecolor": SITE_COLOUR, "edgecolor": "white"}
        text = {"color": "white", "size": 8, "ha": "center", "va": "center", "bbox": box}
        drawn.append(axes.annotate(str(rank), (x, y), annotation_clip=True, **text))
    return drawn


def outline(axes: Any, cells: CellMap, selection: Any = slice(None), **style: Any) -> None:
    """Draw the boundaries of leaves."""
    corner = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]], float)
    centre = np.stack([cells.x, cells.y], axis=-1)
    edges = (centre[:, None, :] + 0.5 * cells.size[:, None, None] * corner)[selection]
    width = float(np.clip(30.0 / np.sqrt(max(cells.level.size, 1)), 0.15, 0.6))
    style = {"colors": "black", "linewidths": width, **style}
    axes.add_collection(LineCollection(list(edges), **style))


def png(figure: Figure, dpi: int = 130) -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=dpi)
    return content.getvalue()
