# SPDX-License-Identifier: Apache-2.0
"""First hit of rays on a bilinear heightfield, all rays of a scan at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadtree_lss.lab.simulation.march import march
from quadtree_lss.onboard.arrays import Array

_WINDOWS = (64, 16, 4)


@dataclass(frozen=True)
class WindowMaxima:
    """For each window size (posts): highest post within one window of each block of that size."""

    maxima: tuple[Array, ...]
    box: Array

    @classmethod
    def of(cls, elevation: Array) -> WindowMaxima:
        """Build from posts (ny, nx)."""
        maxima = []
        for window in _WINDOWS:
            rows, columns = (-(-n // window) for n in elevation.shape)
            blocks = np.full((rows + 2, columns + 2), -np.inf)
            edges_y, edges_x = np.arange(rows) * window, np.arange(columns) * window
            by_row = np.maximum.reduceat(elevation, edges_y, axis=0)
            blocks[1:-1, 1:-1] = np.maximum.reduceat(by_row, edges_x, axis=1)
            along_x = np.maximum(np.maximum(blocks[:, :-2], blocks[:, 1:-1]), blocks[:, 2:])
            maxima.append(np.maximum(np.maximum(along_x[:-2], along_x[1:-1]), along_x[2:]))
        return cls(tuple(maxima), np.array([elevation.min(), elevation.max()]))


def cast_heightfield(
    x: Array,
    y: Array,
    elevation: Array,
    maxima: WindowMaxima,
    origin_map: Array,
    directions_map: Array,
) -> Array:
    """Range (N,) from ``origin_map`` (3,) along ``directions_map`` (N, 3); NaN = no hit."""
    ny, nx = elevation.shape
    dx, dy = (x[-1] - x[0]) / (nx - 1), (y[-1] - y[0]) / (ny - 1)
    origin = np.asarray(origin_map, float)
    # From here on horizontal coordinates count posts; the ray parameter stays a length.
    start = np.array([(origin[0] - x[0]) / dx, (origin[1] - y[0]) / dy, origin[2]])
    speed = np.ascontiguousarray(np.asarray(directions_map, float) / np.array([dx, dy, 1.0]))
    ranges = np.empty(len(speed))
    march(elevation, *maxima.maxima, maxima.box, start, speed, ranges)
    return ranges
