# SPDX-License-Identifier: Apache-2.0
"""The square that is mapped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import DomainConfig


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
        """The domain of a configuration."""
        return cls(config.xmin, config.ymin, config.size, config.min_level, config.max_level)

    @property
    def finest_count(self) -> int:
        """Finest cells along a side."""
        return 1 << self.max_level

    @property
    def finest_size(self) -> float:
        """Side of the finest cell, m."""
        return self.size / self.finest_count

    def cell_size(self, level: NDArray[np.integer] | int) -> Array:
        """Side in m of cells of ``level``, any shape."""
        return self.size / np.exp2(np.asarray(level, dtype=np.float64))
