# SPDX-License-Identifier: Apache-2.0
"""How probable a safe touchdown is: at a place, and where the lander aims at it.

The lander is set down on the map at all headings, or at the one that guidance gives. The true
ground is not the map: how often a lander fails whose worst rest on the map is this was fitted (see
``config.risk.RiskModel``). Where the lander comes down about its aim is normally distributed, and

    P(safe | aim) = sum over grid points of N(point - aim; dispersion) P(safe at the point).

On unseen ground, on ground that is seen but not yet mapped, and beyond the domain's edge no landing
is safe.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import ceil, exp, isnan, log, radians, tan

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.risk import RiskModel, Row
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.lander import Limits
from quadtree_lss.onboard.core.landing.risks import blur, look_up, set_odds
from quadtree_lss.onboard.core.landing.touchdown import WorstRest

#: Ground that rises by so much less than the limit still rises, m; what is added to g's share.
LOWER, NO_ROCKS = 0.12, 3e-5
#: Steps between entries of the tables, in m, rise over run, and of the log odds.
FINE, FINE_ODDS = 2e-4, 0.04
#: A normal distribution is cut off at so many deviations.
TAIL = 4.0
#: The greatest deviation that is taken, m.
WIDEST = 100.0


@dataclass(frozen=True)
class Dispersion:
    """Where the lander comes down about its aim point.

    Attributes:
        x, y: Standard deviations along the axes of the map, m.
        heading: Of the lander, about z from x, rad; None for any.
    """

    x: float
    y: float
    heading: float | None = None

    @staticmethod
    def of(values: ArrayLike | None, lss: LssConfig) -> Dispersion:
        """From standard deviations along x and y, m, and a heading, rad, NaN for any.

        None stands for that of the configuration.

        Raises:
            ValueError: not two or three numbers, or no deviations.
        """
        if values is None:
            return Dispersion(lss.dispersion, lss.dispersion)
        given = np.asarray(values, dtype=np.float64)
        deviations = given[:2]
        if (
            given.shape not in ((2,), (3,))
            or not ((0.0 <= deviations) & (deviations <= WIDEST)).all()
        ):
            msg = f"a dispersion needs two deviations from 0 to {WIDEST:g} m, got {values!r}"
            raise ValueError(msg)
        turned = float(given[2]) if len(given) == 3 else float("nan")
        return Dispersion(float(given[0]), float(given[1]), None if isnan(turned) else turned)


def limits(model: RiskModel, lss: LssConfig) -> Limits:
    """Between what rests the model, and the touchdown check, tell apart."""
    rise, slope = lss.max_roughness, tan(radians(lss.max_slope_deg))
    own, steep = lss.touchdown_roughness, tan(radians(lss.touchdown_slope_deg))
    return Limits(
        (min(rise + model.rise[0], own), max(rise + model.rise[-1], own)),
        (min(slope + model.slope[0], steep), max(slope + model.slope[-1], steep)),
    )


class RiskTable:
    """A model's probabilities for a lander, laid out to be looked up.

    Args:
        model: The fit.
        lss: Limits of the lander.
        noise: Range noise that the mapping is told, one deviation, m.
    """

    def __init__(self, model: RiskModel, lss: LssConfig, noise: float) -> None:
        self._low = np.array(
            [lss.max_roughness + model.rise[0], tan(radians(lss.max_slope_deg)) + model.slope[0]]
        )
        rise, slope = _steps(model.rise, FINE), _steps(model.slope, FINE)
        # Odds that it does not stand, and that it is too steep.
        self._rise_odds = np.exp(np.interp(rise, model.rise, model.rise_odds))
        self._slope_odds = np.exp(np.interp(slope, model.slope, model.slope_odds))
        self._within = np.array([model.own[0], model.own[-1]])
        own, about = _steps(model.own, FINE_ODDS), _steps((0.0, *model.about[1:]), FINE_ODDS)
        self._hats = hats(own, model.own), hats(about, model.about)
        self._tables, self._knots = np.array(model.tables), (model.rocks, model.undulation)
        self._noisy = float(np.interp(noise, model.noise, (0.0, 1.0)))
        self._limits = lss.max_roughness, tan(radians(lss.max_slope_deg))

    def risk(self, worst: WorstRest, judged: Mask, slope: Array) -> Array:
        """P(unsafe) of landing at each grid point, (n + 1, n + 1); 1 where it is not judged.

        Args:
            worst: The lander's worst rests on the map.
            judged: (n + 1, n + 1) grid points of which these are known.
            slope: (n + 1, n + 1) of the ground at the lander's scale, rad.
        """
        own, about = self.log_odds(worst, judged)
        out, least = np.empty(own.shape), float(self._within[0])
        # Not by BLAS: its threads go on waiting for more, and take a core for as long.
        odds = np.einsum("k,kij->ij", self.shares(worst, judged, slope), self._tables)
        at_own = np.einsum("ni,ij->nj", self._hats[0], odds)
        table = 1.0 / (1.0 + np.exp(-np.einsum("nj,mj->nm", at_own, self._hats[1])))
        look_up(own, about, judged.view(np.uint8), table, least, FINE_ODDS, out)
        return out

    def shares(self, worst: WorstRest, judged: Mask, slope: Array) -> Array:
        """What the tables of ``RiskModel`` weigh on this ground, (G + H,); arguments as of `risk`.

        Of the judged grid points at which the lander rests level enough, u is the share at which
        something rises under it beyond the limit, and v at which it nearly does:
        g = log(u (u / v)^3 + 0.00003); h is the mean slope there.
        """
        rise, steep = self._limits
        level = judged & (worst.slope <= steep)
        rises = worst.rise[level]
        count = max(len(rises), 1)
        much, some = (int(np.count_nonzero(rises > at)) for at in (rise, rise - LOWER))
        g = log(much / count * (much / max(some, 1)) ** 3 + NO_ROCKS)
        h = float(np.sum(slope, where=level)) / count
        by_g, by_h = (
            hats(np.array([at]), knots)[0] for at, knots in zip((g, h), self._knots, strict=True)
        )
        return np.concatenate([by_g, by_h[1:], [self._noisy]])

    def log_odds(self, worst: WorstRest, judged: Mask) -> tuple[Array, Array]:
        """What the second step goes by, (n + 1, n + 1) each: l and d of ``RiskModel``."""
        own, about = np.empty((2, *judged.shape))
        set_odds(
            worst.rise,
            worst.slope,
            judged.view(np.uint8),
            self._rise_odds,
            self._slope_odds,
            self._low,
            FINE,
            self._within,
            own,
            about,
        )
        return own, about

    def by_slope(self, rise: float, slope: float) -> bool:
        """Whether it is the slope, and not what rises under the lander, that speaks against it."""
        place = (np.array([rise, slope]) - self._low) / FINE + 0.5
        tables = self._rise_odds, self._slope_odds
        by_rise, by_slope = (
            table[int(min(max(at, 0.0), len(table) - 1.0))]
            for table, at in zip(tables, place.tolist(), strict=True)
        )
        return bool(by_slope > by_rise)


def _steps(knots: Row, step: float) -> Array:
    """From the first knot to the last."""
    return np.arange(0.0, knots[-1] - knots[0] + step, step) + knots[0]


def hats(values: Array, knots: Row) -> Array:
    """(N, K) what the values at knots weigh at (N,) places, in the straight lines between them."""
    ones = np.eye(len(knots))
    return np.column_stack([np.interp(values, knots, one) for one in ones])


def aimed(risk: Array, side: float, dispersion: Dispersion) -> Array:
    """P(unsafe | aim) for each grid point as aim.

    Args:
        risk: (ny, nx) P(unsafe) at the grid points; beyond them it is 1.
        side: Between grid points, m.
        dispersion: Of the touchdown about the aim.
    """
    out = np.empty(risk.shape)
    sides = []
    for sigma, count in zip((dispersion.y, dispersion.x), risk.shape, strict=True):
        weights = normal_weights(sigma, side)
        one = weights[len(weights) // 2 :][:count]
        sides.append(np.append(one, np.zeros(1 - len(one) % 2)))  # pairs, after the first
    blur(risk, *sides, out)
    return out


@lru_cache(maxsize=4)
def normal_weights(sigma: float, side: float) -> Array:
    """Weights (2 K + 1,) of grid points about the aim, along one axis."""
    reach = ceil(TAIL * sigma / side)
    if not reach:
        return np.ones(1)
    weights = np.array([exp(-0.5 * (k * side / sigma) ** 2) for k in range(-reach, reach + 1)])
    return np.asarray(weights / weights.sum())


@dataclass(frozen=True)
class Remainder:
    """What most of the risk at an aim point comes from.

    Attributes:
        probability: P(safe | aim).
        away, bearing: Where from the aim, m, and rad from x to y.
        kind: ``obstacle``, ``slope``, ``unseen`` or ``unmapped``.
    """

    probability: float
    away: float
    bearing: float
    kind: str

    def words(self) -> str:
        """As in "99.2 % safe: the remaining risk is an obstacle 3.1 m east"; where none is
        worth a word, the share alone."""
        share = f"{shown(self.probability)} safe"
        what = {
            "obstacle": "an obstacle",
            "slope": "too steep a slope",
            "unseen": "unseen ground",
            "unmapped": "ground not yet mapped",
        }[self.kind]
        if self.probability >= 0.9999:
            return share
        if self.away < 0.1:
            return f"{share}: the remaining risk is {what} here"
        away = f"{self.away:.1f} m {heading_word(self.bearing)}"
        return f"{share}: the remaining risk is {what} {away}"


def shown(probability: float) -> str:
    """A probability in per cent, with the digits that tell it from certainty; never 100."""
    if isnan(probability):
        return "-"
    share = 100.0 * min(probability, 0.9999)
    return f"{share:.2f} %" if share > 99.9 else f"{share:.1f} %"


def heading_word(bearing: float) -> str:
    """East, north-east ... for an angle from x to y, rad."""
    names = "east north-east north north-west west south-west south south-east".split()
    return names[round(bearing / (0.25 * np.pi)) % 8]


def remainder(
    risk: Array,
    judged: Mask,
    worst: WorstRest,
    table: RiskTable,
    side: float,
    dispersion: Dispersion,
    place: tuple[int, int],
    unmapped: Callable[[int, int], bool],
) -> Remainder:
    """What speaks against an aim point, given by row and column of the lattice.

    ``unmapped`` tells of such a place whether its ground was seen but is not yet mapped.
    """
    across, along = normal_weights(dispersion.y, side), normal_weights(dispersion.x, side)
    up, right = len(across) // 2, len(along) // 2
    south, west = max(place[0] - up, 0), max(place[1] - right, 0)
    known = risk[south : place[0] + up + 1, west : place[1] + right + 1]
    share = across[:, None] * along
    south, west = south - place[0] + up, west - place[1] + right
    share[south : south + known.shape[0], west : west + known.shape[1]] *= known
    row, column = divmod(int(np.argmax(share)), len(along))
    y, x = (row - up) * side, (column - right) * side
    row, column = row + place[0] - up, column + place[1] - right
    inside = 0 <= row < risk.shape[0] and 0 <= column < risk.shape[1]
    kind = "unseen"
    if inside and judged[row, column]:
        steep = table.by_slope(float(worst.rise[row, column]), float(worst.slope[row, column]))
        kind = "slope" if steep else "obstacle"
    elif inside and unmapped(row, column):
        kind = "unmapped"
    return Remainder(1.0 - float(share.sum()), float(np.hypot(x, y)), float(np.arctan2(y, x)), kind)
