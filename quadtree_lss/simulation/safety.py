# SPDX-License-Identifier: Apache-2.0
"""True safety: the contact of a four-legged lander with the posts of a DEM (Fig. 21).

Geometry. Four pads stand on a circle, 90° apart, at fixed horizontal offsets from the vehicle's
centre. Each pad rests on the highest post under it (posts within the pad's radius, and the
bilinear surface under its centre, which matters only where posts are too wide apart for one to lie
under the pad). Four rigid pads touch uneven ground with three: the pads of the diagonal whose mean
height is larger carry the vehicle, and it rocks onto either one of the other two. These are the two
planes through three pads under which the fourth pad's ground does not reach. A place is unsafe
if, at any yaw, either plane is steeper than the limit or any post within the circle is higher above
it (vertically) than the clearance. Yaws divide the 90° after which the four pads repeat.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadtree_lss.simulation.terrain import FloatArray, bilinear

BoolArray = NDArray[np.bool_]

_TOLERANCE = 1e-9  # m: a post on the very rim of a pad or of the circle is under it
_CHUNK = 1024


@dataclass(frozen=True)
class Lander:
    """Dimensions (m) and limits of the vehicle."""

    diameter: float = 3.7
    pad_radius: float = 0.15
    max_slope_deg: float = 10.0
    max_roughness: float = 0.3
    yaws: int = 16


@dataclass(frozen=True)
class _Posts:
    """A DEM with the arithmetic of finding posts."""

    x: FloatArray
    y: FloatArray
    elevation: FloatArray

    @property
    def step(self) -> tuple[float, float]:
        return (
            float(self.x[-1] - self.x[0]) / (self.x.size - 1),
            float(self.y[-1] - self.y[0]) / (self.y.size - 1),
        )

    def window(self, radius: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Offsets, from the first post of a disc's bounding square, that a disc can contain."""
        dx, dy = self.step
        columns = np.arange(int(2.0 * radius / dx + 1e-6) + 2)
        rows = np.arange(int(2.0 * radius / dy + 1e-6) + 2)
        # The centre lies between radius − step and radius from the first post.
        gap_x = np.maximum(np.maximum(radius - dx - columns * dx, columns * dx - radius), 0.0)
        gap_y = np.maximum(np.maximum(radius - dy - rows * dy, rows * dy - radius), 0.0)
        near = gap_x[None, :] ** 2 + gap_y[:, None] ** 2 <= (radius + 1e-6) ** 2
        j, i = np.nonzero(near)
        return i, j

    def first(
        self, x: FloatArray, y: FloatArray, radius: float
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Indices of the first post of the bounding square of discs."""
        dx, dy = self.step
        reach = radius + _TOLERANCE
        i = np.ceil((x - reach - self.x[0]) / dx - 1e-7).astype(np.int64)
        j = np.ceil((y - reach - self.y[0]) / dy - 1e-7).astype(np.int64)
        return i, j


def contact_safe(
    x: ArrayLike,
    y: ArrayLike,
    elevation: ArrayLike,
    points: ArrayLike,
    lander: Lander | None = None,
) -> BoolArray:
    """Whether a lander centred at each of ``points`` (K, 2), map frame, m, stands safely: (K,).

    ``x`` (nx,), ``y`` (ny,), ``elevation`` (ny, nx) are the DEM. A point whose lander would reach
    over the edge of the DEM is unsafe.
    """
    lander = lander or Lander()
    posts = _Posts(
        np.asarray(x, np.float64), np.asarray(y, np.float64), np.asarray(elevation, np.float64)
    )
    centres = np.asarray(points, np.float64).reshape(-1, 2)
    safe = np.zeros(len(centres), bool)
    candidates = np.flatnonzero(on_dem(posts.x, posts.y, centres, lander))
    for start in range(0, candidates.size, _CHUNK):
        chunk = candidates[start : start + _CHUNK]
        safe[chunk] = _chunk_safe(posts, centres[chunk, 0], centres[chunk, 1], lander)
    return safe


def on_dem(x: ArrayLike, y: ArrayLike, points: ArrayLike, lander: Lander) -> BoolArray:
    """Whether all of a lander centred at ``points`` (K, 2) is over the DEM: (K,)."""
    posts_x, posts_y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    centres = np.asarray(points, np.float64).reshape(-1, 2)
    reach = 0.5 * lander.diameter + lander.pad_radius - _TOLERANCE
    return np.asarray(
        (centres[:, 0] - reach >= posts_x[0])
        & (centres[:, 0] + reach <= posts_x[-1])
        & (centres[:, 1] - reach >= posts_y[0])
        & (centres[:, 1] + reach <= posts_y[-1])
    )


def safety_map(
    x: ArrayLike,
    y: ArrayLike,
    elevation: ArrayLike,
    grid_x: ArrayLike,
    grid_y: ArrayLike,
    lander: Lander | None = None,
) -> BoolArray:
    """True safety at the points of a grid: (len(grid_y), len(grid_x)); see `contact_safe`."""
    x_of, y_of = np.asarray(grid_x, np.float64), np.asarray(grid_y, np.float64)
    points = np.stack(np.meshgrid(x_of, y_of), axis=-1).reshape(-1, 2)
    return contact_safe(x, y, elevation, points, lander).reshape(y_of.size, x_of.size)


def _pad_heights(posts: _Posts, x: FloatArray, y: FloatArray, radius: float) -> FloatArray:
    """Highest ground under pads centred at (x, y), any shape."""
    height = bilinear(posts.x, posts.y, posts.elevation, x, y)
    i0, j0 = posts.first(x, y, radius)
    nx, ny = posts.x.size, posts.y.size
    dx, dy = posts.step
    # Offsets of the first post from the pad's centre; the others follow by whole steps.
    left, low = posts.x[0] + i0 * dx - x, posts.y[0] + j0 * dy - y
    flat = posts.elevation.ravel()
    corner = j0 * nx + i0
    limit = (radius + _TOLERANCE) ** 2
    for i, j in zip(*posts.window(radius), strict=True):
        under = (left + i * dx) ** 2 + (low + j * dy) ** 2 <= limit
        index = np.where(under & (i0 + i < nx) & (j0 + j < ny), corner + j * nx + i, -1)
        np.maximum(height, np.where(index >= 0, flat[index], -np.inf), out=height)
    return height


def _rocking_planes(
    heights: FloatArray, angles: FloatArray, radius: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Both planes at every yaw: elevation at the centre and gradients, each (n, 2·yaws).

    ``heights`` (n, 4·yaws) are the pads' heights at ``angles``, which go once round the circle.
    """
    yaws = angles.size // 4
    h = heights.reshape(len(heights), 4, yaws)
    first_carries = h[:, 0] + h[:, 2] >= h[:, 1] + h[:, 3]
    # The carrying diagonal a–c, the other one b–d, 90° further on.
    a = np.where(first_carries, h[:, 0], h[:, 1])
    b = np.where(first_carries, h[:, 1], h[:, 2])
    c = np.where(first_carries, h[:, 2], h[:, 3])
    d = np.where(first_carries, h[:, 3], h[:, 0])
    angle = np.where(first_carries, angles[:yaws], angles[yaws : 2 * yaws])
    centre = 0.5 * (a + c)
    along = 0.5 * (a - c) / radius
    planes = []
    for across in ((b - centre) / radius, (centre - d) / radius):
        planes.append(
            (
                centre,
                along * np.cos(angle) - across * np.sin(angle),
                along * np.sin(angle) + across * np.cos(angle),
            )
        )
    merged = [np.concatenate([planes[0][k], planes[1][k]], axis=1) for k in range(3)]
    return merged[0], merged[1], merged[2]


def _chunk_safe(posts: _Posts, x: FloatArray, y: FloatArray, lander: Lander) -> BoolArray:
    """Exact safety of lander centres (n,)."""
    radius = 0.5 * lander.diameter
    angles = 0.5 * np.pi / lander.yaws * np.arange(4 * lander.yaws, dtype=np.float64)
    pad_x = x[:, None] + radius * np.cos(angles)
    pad_y = y[:, None] + radius * np.sin(angles)
    heights = _pad_heights(posts, pad_x, pad_y, lander.pad_radius)
    centre, slope_x, slope_y = _rocking_planes(heights, angles, radius)
    steep = np.hypot(slope_x, slope_y) > np.tan(np.radians(lander.max_slope_deg))
    safe = ~steep.any(axis=1)
    level = np.flatnonzero(safe)
    if level.size:
        mean = heights[level].mean(axis=1)
        tilt_x = 2.0 * (heights[level] * np.cos(angles)).mean(axis=1) / radius
        tilt_y = 2.0 * (heights[level] * np.sin(angles)).mean(axis=1) / radius
        safe[level] = _clear(
            posts,
            (x[level], y[level]),
            (mean, tilt_x, tilt_y),
            (centre[level], slope_x[level], slope_y[level]),
            radius,
            lander.max_roughness,
        )
    return np.asarray(safe, bool)


def _clear(
    posts: _Posts,
    centres: tuple[FloatArray, FloatArray],
    mean_plane: tuple[FloatArray, FloatArray, FloatArray],
    planes: tuple[FloatArray, FloatArray, FloatArray],
    radius: float,
    clearance: float,
) -> BoolArray:
    """Whether no post within the circle is more than ``clearance`` above any of the planes.

    The highest post above the mean plane of the pads bounds the answer from both sides: that post
    is above each plane by a known amount, and no post is above a plane by more than that height
    and what the two planes differ by within the circle. Only what stays open is worked out.
    """
    x, y = centres
    offset_x, offset_y, z = _circle(posts, x, y, radius)
    z = z - (
        mean_plane[0][:, None]
        + mean_plane[1][:, None] * offset_x
        + mean_plane[2][:, None] * offset_y
    )
    top = z.argmax(axis=1)
    rows = np.arange(len(x))
    highest, top_x, top_y = z[rows, top], offset_x[rows, top], offset_y[rows, top]
    shift = planes[0] - mean_plane[0][:, None]
    turn_x = planes[1] - mean_plane[1][:, None]
    turn_y = planes[2] - mean_plane[2][:, None]
    at_least = highest[:, None] - shift - turn_x * top_x[:, None] - turn_y * top_y[:, None]
    at_most = highest[:, None] - shift + (radius + _TOLERANCE) * np.hypot(turn_x, turn_y)
    clear = ~(at_least > clearance).any(axis=1)
    undecided = (at_most > clearance) & clear[:, None]
    # Planes most likely to be violated first: most points need only that one.
    order = np.argsort(-at_most, axis=1)
    for rank in range(order.shape[1]):
        k = order[:, rank]
        todo = np.flatnonzero(undecided[rows, k] & clear)
        if not todo.size:
            if not (undecided & clear[:, None]).any():
                break
            continue
        plane = k[todo]
        above = (
            z[todo]
            - shift[todo, plane][:, None]
            - turn_x[todo, plane][:, None] * offset_x[todo]
            - turn_y[todo, plane][:, None] * offset_y[todo]
        )
        clear[todo] = above.max(axis=1) <= clearance
        undecided[todo, plane] = False
    return np.asarray(clear, bool)


def _circle(
    posts: _Posts, x: FloatArray, y: FloatArray, radius: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Posts within circles: offsets from the centres and elevations (n, m); −inf = outside."""
    i0, j0 = posts.first(x, y, radius)
    i, j = posts.window(radius)
    dx, dy = posts.step
    offset_x = (posts.x[0] + i0 * dx - x)[:, None] + i * dx
    offset_y = (posts.y[0] + j0 * dy - y)[:, None] + j * dy
    nx, ny = posts.x.size, posts.y.size
    columns, rows = i0[:, None] + i, j0[:, None] + j
    index = np.minimum(rows, ny - 1) * nx + np.minimum(columns, nx - 1)
    within = offset_x**2 + offset_y**2 <= (radius + _TOLERANCE) ** 2
    return offset_x, offset_y, np.where(within, posts.elevation.ravel()[index], -np.inf)
