# SPDX-License-Identifier: Apache-2.0
"""The square that is mapped."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.limits import STEP_LEVEL
from quadtree_lss.onboard.config.settings import DomainConfig

Kind = TypeVar("Kind", bound=np.generic)

#: A square that follows a point moves when the point is farther from its middle than this share of
#: its side, along x or y.
FOLLOW_SHARE = 1.0 / 8.0
#: Greatest coordinate of a corner, m (``domain.xmin``).
MAX_CORNER = 1e8
#: Rounding error of a displacement by whole cells, cells.
CELL_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Domain:
    """The square that is mapped, map frame. ``xmin``, ``ymin``: south-western corner, m. ``size``:
    side, m. ``min_level``, ``max_level``: a cell of level l has side size / 2^l."""

    xmin: float
    ymin: float
    size: float
    min_level: int
    max_level: int

    @classmethod
    def of(cls, config: DomainConfig) -> Domain:
        """Return the domain of a configuration."""
        return cls(config.xmin, config.ymin, config.size, config.min_level, config.max_level)

    @property
    def finest_count(self) -> int:
        """Finest cells along a side."""
        return 1 << self.max_level

    @property
    def finest_size(self) -> float:
        """Side of the finest cell, m."""
        return self.size / self.finest_count

    def steps_to(self, x: float, y: float) -> tuple[int, int]:
        """Return by how many coarsest cells along x and y the square has to move to follow a point,
        m; 0 while the point is near its middle, or is not finite."""
        level = min(self.min_level, STEP_LEVEL)
        step, steps = self.size / (1 << level), []
        for corner, place in ((self.xmin, x), (self.ymin, y)):
            off = place - corner - 0.5 * self.size
            far = FOLLOW_SHARE * self.size < abs(off) and abs(place) < MAX_CORNER - self.size
            steps.append(round(off / step) << (self.min_level - level) if far else 0)
        return steps[0], steps[1]

    def moved(self, east: int, north: int) -> Domain:
        """Return the square moved by a number of coarsest cells along x and y."""
        step = self.size / (1 << self.min_level)
        return replace(self, xmin=self.xmin + east * step, ymin=self.ymin + north * step)

    def cells_to(self, other: Domain) -> tuple[int, int] | None:
        """Return by how many finest cells along x and y another square is moved; None if it is not
        this one moved by whole cells."""
        side = self.finest_size
        east, north = (other.xmin - self.xmin) / side, (other.ymin - self.ymin) / side
        cells = round(east), round(north)
        off = max(abs(east - cells[0]), abs(north - cells[1]))
        alike = replace(other, xmin=self.xmin, ymin=self.ymin) == self
        return cells if alike and off <= CELL_TOLERANCE else None

    def cell_size(self, level: NDArray[np.integer] | int) -> Array:
        """Return the side of cells of a level, m, of any shape."""
        return self.size / np.exp2(np.asarray(level, dtype=np.float64))


def carried(values: NDArray[Kind], east: int, north: int, fill: Any) -> NDArray[Kind]:
    """Return values (..., ny, nx) of a square's cells for the square moved by a number of cells
    along x and y; ``fill`` for new cells."""
    ny, nx = values.shape[-2:]
    out = np.roll(values, (-north, -east), axis=(-2, -1))
    y, x = np.arange(ny) + north, np.arange(nx) + east
    out[..., (y < 0) | (y >= ny), :] = fill
    out[..., (x < 0) | (x >= nx)] = fill
    return out
