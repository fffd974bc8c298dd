# SPDX-License-Identifier: Apache-2.0
"""What the figures share: axes in metres, images on a lattice, contours, scale bars, colours.

Colour maps are those of the page (`report.palette`), legible without red and green.
Classes have colours of Okabe and Ito's palette, distinct for all common kinds of colour vision.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Circle, Rectangle
from scipy.ndimage import gaussian_filter

from quadtree_lss.desk.report.palette import MAPS, shaded
from quadtree_lss.lab.evaluation.results import Truth
from quadtree_lss.lab.simulation.safety import Lander
from quadtree_lss.onboard.arrays import Array

_CONTOUR_SMOOTHING = 0.25  # m

Box = tuple[float, float, float, float]
"""xmin, xmax, ymin, ymax; m."""

SAFE_FOUND, HAZARD_FOUND, FALSE_ALARM, MISSED, UNSEEN_GROUND = (
    "#56b4e9",
    "#7f7f7f",
    "#f0e442",
    "#d55e00",
    "#ffffff",
)
RUNS = ("#e69f00", "#0072b2", "#cc79a7", "#009e73", "#d55e00", "#56b4e9")
"""One colour per run where several are in one picture."""


def map_axes(title: str, box: Box) -> tuple[Figure, Axes]:
    """Axes in metres, equal in scale, showing ``box``, with a scale bar."""
    figure = Figure(figsize=(7.6, 6.6), layout="constrained")
    axes = figure.add_subplot()
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.set_title(title, fontsize="medium")
    axes.set(xlim=box[:2], ylim=box[2:])
    scale_bar(axes, box)
    return figure, axes


def scale_bar(axes: Axes, box: Box) -> None:
    """A bar of 1, 2 or 5 times a power of ten metres, about a fifth of the width."""
    width, height = box[1] - box[0], box[3] - box[2]
    wanted = 0.2 * width
    ten = 10.0 ** np.floor(np.log10(wanted))
    length = max(step * ten for step in (1.0, 2.0, 5.0) if step * ten <= wanted * (1.0 + 1e-9))
    x, y = box[0] + 0.04 * width, box[2] + 0.04 * height
    pad = 0.012 * width
    plate = Rectangle((x - pad, y - pad), length + 2 * pad, 0.05 * height)
    plate.set(facecolor="white", edgecolor="none", alpha=0.8, zorder=9)
    axes.add_patch(plate)
    axes.plot([x, x + length], [y, y], color="black", lw=2.5, solid_capstyle="butt", zorder=10)
    axes.text(
        x + 0.5 * length,
        y + 0.008 * height,
        f"{length:g} m",
        ha="center",
        va="bottom",
        fontsize="small",
        zorder=10,
    )


def image(axes: Axes, x: Array, y: Array, values: np.ndarray, **style: object) -> AxesImage:
    """An array (ny, nx) with samples at x, y; leaves the limits of the axes alone."""
    dx, dy = 0.5 * float(x[1] - x[0]), 0.5 * float(y[1] - y[0])
    extent = (float(x[0]) - dx, float(x[-1]) + dx, float(y[0]) - dy, float(y[-1]) + dy)
    limits = axes.get_xlim(), axes.get_ylim()
    style = {"interpolation": "nearest", **style}
    shown = axes.imshow(values, origin="lower", extent=extent, **style)  # type: ignore[arg-type]
    axes.set(xlim=limits[0], ylim=limits[1])
    return shown


def relief(axes: Axes, x: Array, y: Array, z: Array, low: float, high: float) -> ScalarMappable:
    """Elevations (ny, nx) as on the page: in its colours, lit from the north-west."""
    scale = ScalarMappable(Normalize(low, high), MAPS["elevation"])
    colours = scale.to_rgba(np.ma.masked_invalid(z))[..., :3]
    colours[~np.isfinite(z)] = 1.0
    image(axes, x, y, shaded(colours, z, float(x[1] - x[0])))
    return scale


def truth_window(truth: Truth, box: Box) -> tuple[Array, Array, Array]:
    """The part of the DEM inside a box: x, y, elevation."""
    columns = np.flatnonzero((truth.x >= box[0]) & (truth.x <= box[1]))
    rows = np.flatnonzero((truth.y >= box[2]) & (truth.y <= box[3]))
    if columns.size < 2 or rows.size < 2:
        return truth.x, truth.y, truth.elevation
    return truth.x[columns], truth.y[rows], truth.elevation[np.ix_(rows, columns)]


def contours(axes: Axes, truth: Truth, box: Box) -> None:
    """Contour lines of the true elevation, smoothed so that pebbles have none."""
    x, y, z = truth_window(truth, box)
    z = gaussian_filter(z, _CONTOUR_SMOOTHING / (x[1] - x[0]))
    thin = max(1, z.shape[0] // 300)
    x, y, z = x[::thin], y[::thin], z[::thin, ::thin]
    low, high = limits(z)
    if high > low:
        levels = np.linspace(low, high, 9)
        axes.contour(x, y, z, levels=levels, colors="black", linewidths=0.4, alpha=0.6)


def limits(values: Array) -> tuple[float, float]:
    """Colour limits of elevations that a few rock tops do not stretch."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = np.percentile(finite, (0.2, 99.8))
    return float(low), float(high)


def around(truth: Truth) -> Box:
    """The scanned box and a vehicle's radius around it."""
    xmin, xmax, ymin, ymax = truth.box
    reach = 0.5 * Lander().diameter + 0.15
    return xmin - reach, xmax + reach, ymin - reach, ymax + reach


def outline(axes: Axes, truth: Truth) -> None:
    """The scanned box."""
    xmin, xmax, ymin, ymax = truth.box
    axes.add_patch(
        Rectangle((xmin, ymin), xmax - xmin, ymax - ymin, fill=False, edgecolor="black", lw=0.8)
    )


def mark(axes: Axes, sites: Array, colour: str = "black", name: str | None = None) -> None:
    """Sites with their rank and the lander's footprint."""
    for rank, (x, y) in enumerate(sites[:, :2], start=1):
        circle = Circle((x, y), 0.5 * Lander().diameter, fill=False, edgecolor=colour, lw=1.4)
        if rank == 1 and name is not None:
            circle.set_label(name)
        axes.add_patch(circle)
        axes.annotate(
            str(rank),
            (x, y),
            ha="center",
            va="center",
            annotation_clip=True,
            fontsize="small",
            weight="bold",
            color=colour,
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.75},
        )
