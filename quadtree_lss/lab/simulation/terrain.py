# SPDX-License-Identifier: Apache-2.0
"""The ground of a simulation: a bilinear elevation model; the parabola of Section VI."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from numbers import Real
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import maximum_filter

from quadtree_lss.desk.exchange.dem import read_dem
from quadtree_lss.desk.exchange.formats import ExchangeError
from quadtree_lss.lab.simulation.march import march
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.errors import QuadtreeLssError

#: Sizes of windows, posts; see `march`.
WINDOWS = (64, 16, 4)


class SimulationError(QuadtreeLssError):
    """A simulation cannot be run with the given options."""


def check(
    settings: object, limits: Mapping[str, tuple[float, float]], error: type[QuadtreeLssError]
) -> None:
    """Raise ``error`` if an attribute is neither None nor a number within its limits."""
    for name, (low, high) in limits.items():
        value = getattr(settings, name)
        if value is not None and not (isinstance(value, Real) and low <= value <= high):
            raise error(f"{name} must be between {low:g} and {high:g}, not {value}")


def spacing(axis: Array) -> float:
    return float(axis[-1] - axis[0]) / (axis.size - 1)


def bilinear(posts_x: Array, posts_y: Array, elevation: Array, x: ArrayLike, y: ArrayLike) -> Array:
    """Interpolate ``elevation`` (ny, nx) at map coordinates of equal shape; NaN outside the posts
    (nx,), (ny,), which ascend in equal steps."""
    x_map, y_map = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
    nx, ny = posts_x.size, posts_y.size
    u = (x_map - posts_x[0]) / spacing(posts_x)
    v = (y_map - posts_y[0]) / spacing(posts_y)
    slack = 1e-9
    inside = (u >= -slack) & (u <= nx - 1 + slack) & (v >= -slack) & (v <= ny - 1 + slack)
    u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
    i = np.clip(u.astype(np.int64), 0, nx - 2)
    j = np.clip(v.astype(np.int64), 0, ny - 2)
    fu, fv = u - i, v - j
    low = elevation[j, i] * (1.0 - fu) + elevation[j, i + 1] * fu
    high = elevation[j + 1, i] * (1.0 - fu) + elevation[j + 1, i + 1] * fu
    return np.where(inside, low * (1.0 - fv) + high * fv, np.nan)


@dataclass(frozen=True)
class Terrain:
    """A bilinear heightfield: posts ``x`` (nx,), ``y`` (ny,), ascending in equal steps,
    ``elevation`` (ny, nx), m, z up. Raises `SimulationError`: the arrays are invalid."""

    x: Array
    y: Array
    elevation: Array

    def __post_init__(self) -> None:
        for name in ("x", "y", "elevation"):
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), np.float64))
        steps = [np.diff(axis) for axis in (self.x, self.y) if axis.ndim == 1 and axis.size > 1]
        even = all(step.min() > 0.0 and np.ptp(step) <= 1e-3 * step.mean() for step in steps)
        if len(steps) < 2 or not even:
            raise SimulationError("terrain: x and y must be vectors that ascend in equal steps")
        shape, expected = self.elevation.shape, (self.y.size, self.x.size)
        if shape != expected:
            raise SimulationError(f"terrain: elevation has shape {shape}, expected {expected}")
        if not np.isfinite(self.elevation).all():
            raise SimulationError("terrain: elevation holds values that are not finite")

    @property
    def post(self) -> tuple[float, float]:
        """Distance between posts (m) along x and y."""
        return spacing(self.x), spacing(self.y)

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        return float(self.x[0]), float(self.x[-1]), float(self.y[0]), float(self.y[-1])

    def scaled(self, scale: float) -> Terrain:
        return Terrain(scale * self.x, scale * self.y, scale * self.elevation)

    def elevation_at(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Bilinear elevation (m) at map coordinates of equal shape; NaN outside."""
        return bilinear(self.x, self.y, self.elevation, x, y)

    @cached_property
    def window_maxima(self) -> tuple[Array, ...]:
        """For each of `WINDOWS`, the highest post within one window of each block of that size."""
        maxima = []
        for window in WINDOWS:
            blocks = self.elevation
            for axis, count in enumerate(blocks.shape):
                blocks = np.maximum.reduceat(blocks, np.arange(0, count, window), axis=axis)
            maxima.append(maximum_filter(blocks, 3, mode="constant", cval=-np.inf))
        return tuple(maxima)

    def cast(self, origin_map: Array, directions_map: Array) -> Array:
        """Range (N,) to the first hit of each ray; NaN without one."""
        dx, dy = self.post
        box = np.array([self.elevation.min(), self.elevation.max()])
        origin = np.asarray(origin_map, float)
        # Horizontal coordinates count posts; the ray parameter stays a length.
        start = np.array([(origin[0] - self.x[0]) / dx, (origin[1] - self.y[0]) / dy, origin[2]])
        speed = np.ascontiguousarray(np.asarray(directions_map, float) / np.array([dx, dy, 1.0]))
        ranges = np.empty(len(speed))
        march(self.elevation, *self.window_maxima, box, start, speed, ranges)
        return ranges


def parabola() -> Terrain:
    """Ground of Section VI, 140 m wide: z = max(a (x² + y² − r²), 0) with a = 3·10⁻³/m, r = 12 m
    (Eq. 60)."""
    axis = np.linspace(-70.0, 70.0, 561)
    squared = axis[None, :] ** 2 + axis[:, None] ** 2
    return Terrain(axis, axis, np.maximum(3e-3 * (squared - 12.0**2), 0.0))


def load_terrain(path: str | Path) -> Terrain:
    """Read a DEM with `read_dem`. Raises `SimulationError`: it cannot be read or has gaps."""
    try:
        model = read_dem(Path(path))
        return Terrain(model.x, model.y, model.elevation)
    except SimulationError as error:
        text = str(error).removeprefix("terrain: ")
        raise SimulationError(f"terrain file {path}: {text}") from error
    except ExchangeError as error:
        raise SimulationError(f"terrain file {error}") from error
