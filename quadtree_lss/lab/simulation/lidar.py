# SPDX-License-Identifier: Apache-2.0
"""A flash lidar and a stereo camera: all pixels measure at one instant."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.random import Generator
from scipy.ndimage import uniform_filter

from quadtree_lss.lab.simulation.terrain import Terrain
from quadtree_lss.onboard.arrays import Array

#: Largest error of a false return, m.
MAX_OUTLIER = 10.0


@cache
def pixel_beams(width_deg: float, height_deg: float, columns: int, rows: int) -> Array:
    """Unit directions (rows, columns, 3) over a field of view, read-only."""
    across = np.radians(width_deg) * ((np.arange(columns) + 0.5) / columns - 0.5)
    down = np.radians(height_deg) * ((np.arange(rows) + 0.5) / rows - 0.5)
    azimuth, elevation = np.meshgrid(across, -down)
    level = np.cos(elevation)
    # Eq. 14 with ρ = 1.
    beams = np.stack(
        [np.sin(azimuth) * level, np.sin(-elevation), np.cos(azimuth) * level], axis=-1
    )
    beams.setflags(write=False)
    return beams


@dataclass(frozen=True)
class FlashLidar:
    """Square array of ``pixels``² beams over a square field of view in the frame of Eq. 14 (z
    boresight, x right, y down). Row 0 is the upper edge, column 0 the left edge."""

    field_of_view_deg: float
    pixels: int = 128
    range_noise: float = 0.06
    outliers: float = 0.0
    dropouts: float = 0.0

    def directions(self) -> Array:
        """Unit beam directions (pixels, pixels, 3) in the lidar frame."""
        side, count = self.field_of_view_deg, self.pixels
        return pixel_beams(side, side, count, count)

    def true_ranges(
        self, terrain: Terrain, position_map: Array, rotation_map_lidar: Array
    ) -> Array:
        """Noise-free ranges (pixels, pixels) from a pose; NaN = no return."""
        directions = self.directions()
        directions_map = directions.reshape(-1, 3) @ rotation_map_lidar.T
        return terrain.cast(position_map, directions_map).reshape(directions.shape[:2])

    def scan(
        self, terrain: Terrain, position_map: Array, rotation_map_lidar: Array, generator: Generator
    ) -> Array:
        """Points (pixels, pixels, 3) in the lidar frame, NaN = no return, with Gaussian range noise
        (Eq. 13), ``outliers`` and ``dropouts``."""
        ranges = self.true_ranges(terrain, position_map, rotation_map_lidar)
        ranges = ranges + generator.normal(0.0, self.range_noise, ranges.shape)
        if self.outliers > 0.0:
            wrong = generator.random(ranges.shape) < self.outliers
            error = generator.uniform(-MAX_OUTLIER, MAX_OUTLIER, ranges.shape)
            ranges = np.where(wrong, ranges + error, ranges)
        if self.dropouts > 0.0:
            ranges[generator.random(ranges.shape) < self.dropouts] = np.nan
        ranges[ranges <= 0.0] = np.nan
        return np.asarray(ranges[..., None] * self.directions())


@dataclass(frozen=True)
class StereoCamera(FlashLidar):
    """Depths along z as of a RealSense D455, in whole millimetres. The Gaussian disparity noise is
    averaged over 3 x 3 pixels; half of the pixels at an edge get an intermediate depth."""

    field_of_view_deg: float = 64.0
    columns: int = 640
    rows: int = 480
    focal_length: float = 385.0
    baseline: float = 0.095
    disparity_sigma: float = 0.08

    def directions(self) -> Array:
        """Unit directions of the pixels (rows, columns, 3)."""
        u, v = np.meshgrid(np.arange(float(self.columns)), np.arange(float(self.rows)))
        f, middle = self.focal_length, (0.5 * (self.columns - 1), 0.5 * (self.rows - 1))
        rays = np.stack([(u - middle[0]) / f, (v - middle[1]) / f, np.ones_like(u)], axis=-1)
        return rays / np.linalg.norm(rays, axis=-1, keepdims=True)

    def scan(
        self, terrain: Terrain, position_map: Array, rotation_map_lidar: Array, generator: Generator
    ) -> Array:
        """Measured points (rows, columns, 3), NaN = no return."""
        rays = self.directions()
        z = self.true_ranges(terrain, position_map, rotation_map_lidar) * rays[..., 2]
        for axis in (0, 1):  # smear depths across edges
            beside = np.roll(z, 1, axis)
            share = generator.random(z.shape)
            smeared = (np.abs(beside - z) > 0.02 * z) & (generator.random(z.shape) < 0.5)
            z = np.where(smeared, share * z + (1.0 - share) * beside, z)
        noise = uniform_filter(generator.normal(0.0, 3.0 * self.disparity_sigma, z.shape), 3)
        product = self.focal_length * self.baseline
        with np.errstate(invalid="ignore", divide="ignore"):
            z = product / (product / z + noise)
            z = np.where((z > 0.0) & (z < 65.0), np.rint(1e3 * z) / 1e3, np.nan)
        z[generator.random(z.shape) < self.dropouts] = np.nan
        return np.asarray(rays / rays[..., 2:] * z[..., None])
