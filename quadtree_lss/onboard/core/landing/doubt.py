# SPDX-License-Identifier: Apache-2.0
"""How far the risks that are told can be doubted: a run outside the fit, and what came of them.

All who give out an answer give out its doubts (`LandingAssessment.doubts`).
"""

from __future__ import annotations

from math import ceil, sqrt

import numpy as np

from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.risk import doubt
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.tree.domain import Domain, carried

#: Greatest share of the judged ground without a return: flights that were fitted have up to 0.02.
MOST_BRIDGED = 0.05
#: Risks are looked at in hindsight between these.
BINS = (0.0, 0.003, 0.03, 0.3)
#: They may come true so many times, and by so many deviations more than that.
TIMES, DEVIATIONS = 2.0, 3.0


class Doubts:
    """Doubts of the assessments of one map as it grows; arguments as of `LandingSiteSelector`."""

    def __init__(self, config: Config) -> None:
        self._outside = doubt(config)
        self._hindsight = Hindsight(config.vehicle.diameter)

    def of(self, raster: TerrainRaster, risk: Array, judged: Mask) -> tuple[str, ...]:
        """A line each, none where there is none.

        Args:
            raster: The map.
            risk: (n + 1, n + 1) P(unsafe) of landing at each grid point.
            judged: (n + 1, n + 1) grid points where that is known.
        """
        self._hindsight.take(raster.domain, raster.cells.stamp_ns, risk, judged)
        lines = (self._outside, coverage(raster, judged), self._hindsight.words())
        return tuple(line for line in lines if line)


def coverage(raster: TerrainRaster, judged: Mask) -> str:
    """Whether the ground that is judged is seen more thinly than that of the fit; or nothing."""
    under = raster.bridged[judged[1:, 1:]]
    share = np.count_nonzero(under) / max(len(under), 1)
    if share <= MOST_BRIDGED:
        return ""
    return (
        f"{100.0 * share:.0f} % of the judged ground has no return and is bridged: the risk was"
        f" fitted where at most {100.0 * MOST_BRIDGED:.0f} % is"
    )


class Hindsight:
    """Risks that were told early against what the grown map says of the same places.

    A risk that is right is on average what it will be when more is known:
    E[later risk | first risk] = first risk. Places are half a diameter apart; four of them are one
    lander's ground and count as one, for the risks of neighbours are alike.

    Args:
        diameter: Of the vehicle, m.
    """

    def __init__(self, diameter: float) -> None:
        self._step = 0.5 * diameter
        self._of: Domain | None = None
        self._stamp_ns = 0
        self._first = self._last = np.zeros((0, 0))
        # By how many finest cells the square was moved since the first assessment.
        self._at = (0, 0)

    def take(self, domain: Domain, stamp_ns: int, risk: Array, judged: Mask) -> None:
        """Take one more assessment; one of another map, or of one begun anew, begins anew.
        A domain that was moved is the same map."""
        step = ceil(self._step / domain.finest_size)
        count = (domain.finest_count + 1) // step
        moved = None if self._of is None else self._of.cells_to(domain)
        if moved is None or stamp_ns < self._stamp_ns:
            moved, self._at = (0, 0), (0, 0)
            self._first = np.full((count, count), np.nan)
        self._of, self._stamp_ns = domain, stamp_ns
        # The same places, wherever the square lies: multiples of the step from where it lay first.
        before = [ceil(at / step) for at in self._at]
        self._at = self._at[0] + moved[0], self._at[1] + moved[1]
        now = [ceil(at / step) for at in self._at]
        self._first = carried(self._first, now[0] - before[0], now[1] - before[1], np.nan)
        columns, rows = (
            step * (first + np.arange(count)) - at for first, at in zip(now, self._at, strict=True)
        )
        every = np.ix_(rows, columns)
        risks = np.where(judged[every], risk[every], np.nan)
        self._first = np.where(np.isnan(self._first), risks, self._first)
        self._last = risks

    def words(self) -> str:
        """As in "of the ground told 1 % of risk, 4 % is unsafe by the grown map"; or nothing."""
        for low, high in zip(BINS, BINS[1:], strict=False):
            chosen = (self._first >= low) & (self._first < high) & np.isfinite(self._last)
            landers = 0.25 * np.count_nonzero(chosen)
            told = float(np.sum(self._first, where=chosen)) * 0.25
            later = float(np.sum(self._last, where=chosen)) * 0.25
            if later > TIMES * told + DEVIATIONS * sqrt(told) + 1.0:
                return (
                    f"of the ground told {100.0 * told / landers:.2g} % of risk at first,"
                    f" {100.0 * later / landers:.2g} % is unsafe by the map as it is now:"
                    " risks told early do not come true"
                )
        return ""
