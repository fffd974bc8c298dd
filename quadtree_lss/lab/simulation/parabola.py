# SPDX-License-Identifier: Apache-2.0
"""The terrain of Section VI, a parabola with a flat bottom (Eq. 60), exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.onboard.arrays import Array


@dataclass(frozen=True)
class Parabola:
    """z = a (x² + y² − r²) where that is positive, else 0 (Eq. 60: a = 3·10⁻³/m, r = 12 m)."""

    curvature: float = 3e-3
    flat_radius: float = 12.0

    def elevation_at(self, x: ArrayLike, y: ArrayLike) -> Array:
        """Elevation (m) at map coordinates (m)."""
        squared = np.square(np.asarray(x, float)) + np.square(np.asarray(y, float))
        return np.asarray(np.maximum(self.curvature * (squared - self.flat_radius**2), 0.0))

    def cast(self, origin_map: Array, directions_map: Array) -> Array:
        """Range (N,) to the first hit; NaN where a ray misses.

        The surface is the higher of plane and paraboloid, hence the first hit is the nearer of
        the two. The height above the paraboloid is concave along a ray, so a ray that starts
        above it meets it at the larger root.
        """
        o, d = np.asarray(origin_map, float), np.asarray(directions_map, float)
        with np.errstate(divide="ignore", invalid="ignore"):
            plane = np.where(d[:, 2] < 0.0, -o[2] / d[:, 2], np.inf)
            a = self.curvature * (d[:, 0] ** 2 + d[:, 1] ** 2)
            b = 2.0 * self.curvature * (o[0] * d[:, 0] + o[1] * d[:, 1]) - d[:, 2]
            c = self.curvature * (o[0] ** 2 + o[1] ** 2 - self.flat_radius**2) - o[2]
            root = np.sqrt(np.maximum(b * b - 4.0 * a * c, 0.0))
            # The larger root of a t² + b t + c, written so that a → 0 loses no digits.
            bowl = np.where(b > 0.0, -2.0 * c / (b + root), (root - b) / (2.0 * a))
        hit = np.fmin(plane, bowl)
        return np.where(np.isfinite(hit) & (hit > 0.0), hit, np.nan)

    def terrain(self, half_width: float = 70.0, post: float = 0.25) -> Terrain:
        """Sample as a DEM about the origin (for the truth file)."""
        count = round(2.0 * half_width / post) + 1
        axis = np.linspace(-half_width, half_width, count)
        return Terrain(axis, axis, self.elevation_at(axis[None, :], axis[:, None]))
