# SPDX-License-Identifier: Apache-2.0
"""What the ground allows, by the touchdown check or by the probability that the lander fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import radians, tan

import numpy as np

from quadtree_lss.onboard.arrays import Array, Index, Mask
from quadtree_lss.onboard.config.risk import risk_model
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.probability import (
    Dispersion,
    Remainder,
    RiskTable,
    aimed,
    limits,
    remainder,
)
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.landing.touchdown import TouchdownCheck, WorstRest


@dataclass(frozen=True)
class Judgement:
    """What is known of landing at the grid points of the finest lattice, (n + 1, n + 1).

    Attributes:
        fails: Where the lander must not be set down.
        uncertain: Of these, where it stands on the map, yet is too likely not to.
        risk: P(unsafe) of landing there; NaN if it is not asked for.
        aimed: P(unsafe | aim) with the dispersion; NaN if it is not asked for.
        judged: Where all ground under the lander is seen and mapped.
        worst: Its worst rests there.
        ranks: Whether sites are ranked by ``aimed``.
        side: Between grid points, m.
        dispersion: Of the touchdown about its aim.
        table: The fit; None if it is not asked for.
    """

    fails: Mask
    uncertain: Mask
    risk: Array
    aimed: Array
    judged: Mask
    worst: WorstRest
    ranks: bool
    side: float
    dispersion: Dispersion
    table: RiskTable | None

    def remainders(
        self, rows: Index, columns: Index, unmapped: Callable[[int, int], bool]
    ) -> list[Remainder]:
        """What most of the risk comes from at aim points (K,); none if risk is not asked for.

        ``unmapped`` is that of ``probability.remainder``.
        """
        if self.table is None:
            return []
        given = self.risk, self.judged, self.worst, self.table, self.side, self.dispersion
        places = zip(rows.tolist(), columns.tolist(), strict=True)
        return [remainder(*given, place, unmapped) for place in places]


class SafetyJudge:
    """Judges maps of a growing terrain; sets the lander down again only where ground changed."""

    def __init__(self, lss: LssConfig, noise: float) -> None:
        """With the lander's limits and the range noise that the mapping is told, m."""
        self.lss = lss
        self._probable = "probability" in (lss.assessment, lss.ranking)
        self._table = RiskTable(risk_model(lss.risk_model), lss, noise) if self._probable else None
        self._heading: float | None = None
        self._check = self._new_check(None)

    def _new_check(self, heading: float | None) -> TouchdownCheck:
        within = limits(risk_model(self.lss.risk_model), self.lss) if self._probable else None
        return TouchdownCheck(self.lss, within, heading)

    def judge(
        self, raster: TerrainRaster, inside: Array, slope: Array, spread: Dispersion
    ) -> Judgement:
        """What the ground allows.

        Args:
            raster: The map.
            inside: (n + 1, n + 1) of ``score.seen_about``.
            slope: (n + 1, n + 1) of ``score.planes_below``, rad.
            spread: Of the touchdown about its aim.
        """
        lss, side = self.lss, raster.domain.finest_size
        if spread.heading != self._heading:
            self._heading = spread.heading
            self._check = self._new_check(spread.heading)
        judged = inside >= 0.5 * lss.vehicle_diameter - 1e-9
        nothing = np.zeros(inside.shape, dtype=np.bool_)
        unknown = np.full(inside.shape, np.nan)
        if not self._probable and lss.assessment == "paper":
            worst = WorstRest(unknown, unknown)
            return Judgement(
                nothing, nothing, unknown, unknown, judged, worst, False, side, spread, None
            )
        worst = self._check.worst(raster, judged)
        fails = judged & self._check.over(worst) if lss.assessment == "touchdown" else nothing
        uncertain, risk, at_aim = nothing, unknown, unknown
        if self._table is not None:
            risk = self._table.risk(worst, judged, slope)
            at_aim = aimed(risk, side, spread)
            if lss.assessment == "probability":
                fails = judged & (risk > lss.max_risk)
                stands = worst.rise <= lss.max_roughness
                stands &= worst.slope <= tan(radians(lss.max_slope_deg))
                uncertain = fails & stands
        return Judgement(
            fails,
            uncertain,
            risk,
            at_aim,
            judged,
            worst,
            lss.ranking == "probability",
            side,
            spread,
            self._table,
        )
