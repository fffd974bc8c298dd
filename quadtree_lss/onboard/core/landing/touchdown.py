# SPDX-License-Identifier: Apache-2.0
"""Touchdown check on the estimated map: how badly the lander rests at each grid point.

It is set down where ground changed since the map before (see ``lander``).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import radians, tan

import numpy as np

from quadtree_lss.onboard.arrays import Mask, Single
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.lander import Lander, Limits
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.tree.domain import Domain


@dataclass(frozen=True)
class WorstRest:
    """How badly the lander rests at its worst heading, (n + 1, n + 1), within ``Limits``.

    Attributes:
        rise: Greatest rise of ground under the lander over a resting plane, m; NaN where nobody
            asked.
        slope: Of the steepest resting plane, rise over run; NaN where nobody asked.
    """

    rise: Single
    slope: Single


class TouchdownCheck:
    """Sets the lander down on maps of a growing terrain.

    How it rests in a block of grid points depends on the cells that its landers can meet alone, so
    blocks where none of them changed are as before, bit for bit.

    Args:
        config: The lander.
        limits: Between what rests to tell apart; by default the touchdown limits alone.
        heading: Of the lander, about z from x, rad; None for all `YAWS`.
    """

    def __init__(
        self, config: LssConfig, limits: Limits | None = None, heading: float | None = None
    ) -> None:
        self.config, self.heading = config, heading
        rise, slope = config.touchdown_roughness, tan(radians(config.touchdown_slope_deg))
        self.limits = limits or Limits((rise, rise), (slope, slope))
        self._domain: Domain | None = None

    def worst(self, raster: TerrainRaster, candidates: Mask) -> WorstRest:
        """The worst rest at grid points.

        A rest that is too steep for the limits is not looked at for what rises over it.

        Args:
            raster: The map on its finest cells.
            candidates: (n + 1, n + 1) points to check; their lander circle lies inside the domain.
        """
        if not candidates.any():  # of a lander wider than the domain the window would be wider, too
            return WorstRest(*np.full((2, *candidates.shape), np.nan, dtype=np.float32))
        if raster.domain != self._domain:
            self._domain = raster.domain
            self._lander = Lander(self.config, self.limits, raster.domain, self.heading)
            self._rest = np.full((2, *candidates.shape), np.nan, dtype=np.float32)
        due, changed = candidates.view(np.uint8), np.zeros(raster.leaf.shape, dtype=np.uint8)
        layers = raster.elevation, raster.slope_x, raster.slope_y, raster.subscale
        self._lander.stand_on(*layers, changed)
        for block in range(self._lander.blocks):  # between them a signal can end it
            self._lander.judge(due, changed, self._rest, block)
        return WorstRest(*self._rest)

    def unsafe(self, raster: TerrainRaster, candidates: Mask) -> Mask:
        """Grid points (n + 1, n + 1) at which some heading is over the touchdown limits."""
        return np.asarray(candidates & self.over(self.worst(raster, candidates)))

    def over(self, worst: WorstRest) -> Mask:
        """Where a rest is over the touchdown limits."""
        steepest = tan(radians(self.config.touchdown_slope_deg))
        high = worst.rise > np.float32(self.config.touchdown_roughness)
        return np.asarray(high | (worst.slope > np.float32(steepest)))
