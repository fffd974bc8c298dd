# SPDX-License-Identifier: Apache-2.0
"""The ground as a lander meets it: how high its pads stand, and what rises under its belly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import LssConfig
from quadtree_lss.core.geometry.feature import SHAPE
from quadtree_lss.core.landing.nodes import disc
from quadtree_lss.core.landing.raster import TerrainRaster

Array = NDArray[np.float64]
Single = NDArray[np.float32]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]

LEVEL_STEP = 64.0
#: Side of the blocks of nodes that are treated together.
BLOCK = 8


class LanderGround:
    """Heights over a round level on the finest cells; a border of cells is repeated outside.

    Attributes:
        radius: Of the lander's circle, m.
        side: Of a finest cell, m.
        level: Height that all others are over, in steps of 64 m: small numbers round finely, and
            the same ground rounds alike while the map grows.
        reach: Cells from a node to the farthest that the lander at the node can meet.
        border: Cells repeated on every side, so that whole blocks fit.
        window: Side of the square of cells that the landers at a block's nodes can meet.
        pad: Height of a pad at each cell's centre: it stands on the highest ground within its
            radius.
        slope_x, slope_y: dz/dx, dz/dy of each cell.
        rise: Of each cell's plane from its centre to the highest corner.
        top: Highest ground of each cell: plane, its rise to the corner, subscale feature (a bell
            fitted to part of a rock is low, so its own peak counts and not the boulder's).
        under: Cells under the lander, relative to its node.
        farthest: Distance of the farthest of them or of the pads, m.
        feet: The places of the pads.
    """

    def __init__(self, raster: TerrainRaster, config: LssConfig) -> None:
        self.radius = 0.5 * config.vehicle_diameter
        self.side = raster.domain.finest_size
        self.level = LEVEL_STEP * float(np.rint(np.mean(raster.elevation) / LEVEL_STEP))
        self.reach = int(np.floor(self.radius / self.side)) + 1
        self.border = self.reach + BLOCK
        self.window = BLOCK - 1 + 2 * self.reach
        height = raster.elevation - self.level
        rise = 0.5 * self.side * (np.abs(raster.slope_x) + np.abs(raster.slope_y))
        tilt = np.sqrt(raster.slope_x**2 + raster.slope_y**2)
        self.pad = self._bordered(height + config.pad_radius * tilt)
        self.slope_x = self._bordered(raster.slope_x)
        self.slope_y = self._bordered(raster.slope_y)
        self.rise = self._bordered(rise)
        self.top = self._bordered(height + rise + SHAPE * raster.subscale)
        self.under = disc(self.radius, self.side)
        self.farthest = max(self.radius, float(np.hypot(self.under.x, self.under.y).max()))
        self.feet = Feet(self.radius, self.side, config.touchdown_yaws)

    @property
    def stride(self) -> int:
        """Cells from one row to the next of the flattened arrays."""
        return int(self.top.shape[1])

    def comparable(self, other: LanderGround) -> bool:
        """True if both lie on the same cells and level."""
        return (self.side, self.level, self.top.shape) == (other.side, other.level, other.top.shape)

    def differs(self, other: LanderGround) -> Mask:
        """Cells (n, n) whose heights differ."""
        out: Mask = self.top != other.top
        out |= self.pad != other.pad
        out |= self.slope_x != other.slope_x
        out |= self.slope_y != other.slope_y
        return out[self.border : -self.border, self.border : -self.border]

    def cell_of(self, row: Index, column: Index) -> Index:
        """Flat index of the cells north-east of nodes (K,)."""
        return (row + self.border) * self.stride + column + self.border

    def window_cells(self, rows: Index, columns: Index) -> Index:
        """Flat index (window, window, B) of the cells about blocks, given their first nodes."""
        offset = np.arange(self.window)
        corner = self.cell_of(rows - self.reach, columns - self.reach)
        out: Index = corner + (offset[:, None] * self.stride + offset)[..., None]
        return out

    def _bordered(self, values: Array) -> Single:
        return np.pad(values.astype(np.float32), self.border, mode="edge")


class Feet:
    """Places of the four pads at each heading, (4, yaws): one after the other around the circle.

    Attributes:
        cos, sin: (yaws,) of the headings, which cover a quarter turn.
        row, column: Cell that a pad stands on, relative to the node's (to its north-east).
        dx, dy: Of the pad from that cell's centre, m.
    """

    def __init__(self, radius: float, side: float, yaws: int) -> None:
        yaw = np.arange(yaws) * (0.5 * np.pi / yaws)
        self.cos, self.sin = np.cos(yaw).astype(np.float32), np.sin(yaw).astype(np.float32)
        c, s = self.cos.astype(np.float64), self.sin.astype(np.float64)
        x, y = radius * np.stack([c, -s, -c, s]), radius * np.stack([s, c, -s, -c])
        self.column = np.floor(x / side).astype(np.intp)
        self.row = np.floor(y / side).astype(np.intp)
        self.dx = (x - (self.column + 0.5) * side).astype(np.float32)
        self.dy = (y - (self.row + 0.5) * side).astype(np.float32)
