# SPDX-License-Identifier: Apache-2.0
"""How probable a safe touchdown is: at a place, and where the lander aims at it.

The lander is set down on the map at all headings, or at the one that guidance gives. The true
ground is not the map: how often a lander fails whose worst contact on the map is this was fitted
(see ``config.risk.RiskModel``). Where the lander comes down about its aim is normally distributed,
and

    P(safe | aim) = sum over grid points of N(point - aim; dispersion) P(safe at the point).

On unseen ground, on ground that is seen but not yet mapped, and beyond the domain's edge no landing
is safe.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import ceil, exp, isnan, radians, tan

import cython
import numpy as np
from cython.cimports.libc.math import log
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Mask, Single
from quadtree_lss.onboard.config.risk import RiskModel, Row
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.touchdown import Limits, WorstContact

#: Ground that rises by so much less than the limit still rises, m; what is added to g's share.
LOWER, NO_ROCKS = 0.12, 3e-5
#: Steps between entries of the tables, in m, rise over run, and of the log odds.
FINE = cython.declare(cython.double, 2e-4)
FINE_ODDS = cython.declare(cython.double, 0.04)
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
    """Between which contacts the model, and the touchdown check, differ."""
    rise, slope = lss.max_roughness, tan(radians(lss.max_slope_deg))
    own, steep = lss.touchdown_roughness, tan(radians(lss.touchdown_slope_deg))
    return Limits(
        (min(rise + model.rise[0], own), max(rise + max(model.rise), own)),
        (min(slope + model.slope[0], steep), max(slope + max(model.slope), steep)),
    )


class RiskTable:
    """A model's probabilities for a lander, laid out to be looked up.

    Args:
        model: The fit.
        lss: Limits of the lander.
        noise: Configured range noise of the mapping, one deviation, m.
    """

    def __init__(self, model: RiskModel, lss: LssConfig, noise: float) -> None:
        self._low = np.array(
            [lss.max_roughness + model.rise[0], tan(radians(lss.max_slope_deg)) + model.slope[0]]
        )
        rise, slope = _steps(model.rise, FINE), _steps(model.slope, FINE)
        # Odds that it does not stand, and that it is too steep.
        self._rise_odds = np.exp(np.interp(rise, model.rise, model.rise_odds))
        self._slope_odds = np.exp(np.interp(slope, model.slope, model.slope_odds))
        self._within = np.array([min(model.own), max(model.own)])
        own, about = _steps(model.own, FINE_ODDS), _steps((0.0, *model.about[1:]), FINE_ODDS)
        self._weights = (
            interpolation_weights(own, model.own),
            interpolation_weights(about, model.about),
        )
        self._tables, self._knots = np.array(model.tables), (model.rocks, model.undulation)
        self._noisy = float(np.interp(noise, model.noise, (0.0, 1.0)))
        self._limits = lss.max_roughness, tan(radians(lss.max_slope_deg))

    def risk(self, worst: WorstContact, judged: Mask, slope: Array) -> Array:
        """P(unsafe) of landing at each grid point, (n + 1, n + 1); 1 where it is not judged.

        Args:
            worst: The lander's worst contacts on the map.
            judged: (n + 1, n + 1) grid points of which these are known.
            slope: (n + 1, n + 1) of the ground at the lander's scale, rad.
        """
        own, about = self.log_odds(worst, judged)
        # Not by BLAS: its threads go on waiting for more, and take a core for as long.
        odds = np.einsum("k,kij->ij", self.shares(worst, judged, slope), self._tables)
        at_own = np.einsum("ni,ij->nj", self._weights[0], odds)
        table = 1.0 / (1.0 + np.exp(-np.einsum("nj,mj->nm", at_own, self._weights[1])))
        out = np.ones(judged.shape)
        look_up(own, about, judged.view(np.uint8), table, float(self._within[0]), out)
        return out

    def shares(self, worst: WorstContact, judged: Mask, slope: Array) -> Array:
        """What the tables of ``RiskModel`` weigh on this ground, (G + H,); arguments as of `risk`.

        Of the judged grid points at which the lander stands level enough, u is the share at which
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
            interpolation_weights(np.array([at]), knots)[0]
            for at, knots in zip((g, h), self._knots, strict=True)
        )
        return np.concatenate([by_g, by_h[1:], [self._noisy]])

    def log_odds(self, worst: WorstContact, judged: Mask) -> tuple[Array, Array]:
        """What the second step goes by, (n + 1, n + 1) each: l and d of ``RiskModel``."""
        own, about = np.empty((2, *judged.shape))
        marks, odds = judged.view(np.uint8), (self._rise_odds, self._slope_odds)
        set_odds(worst.rise, worst.slope, marks, *odds, self._low, self._within, own, about)
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
    return np.arange(0.0, max(knots) - knots[0] + step, step) + knots[0]


def interpolation_weights(values: Array, knots: Row) -> Array:
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
    # Beyond forty deviations there is nothing, and their square may be no number.
    away = [min(abs(k) * side / sigma, 40.0) for k in range(-reach, reach + 1)]
    weights = np.array([exp(-0.5 * of**2) for of in away])
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
        """As in "probability 99.2 %: the remaining risk is an obstacle 3.1 m east"; where none
        is worth a word, the probability alone."""
        share = f"probability {shown(self.probability)}"
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


def remaining_risks(
    places: tuple[Index, Index],
    risk: Array,
    judged: Mask,
    unmapped: Mask,
    worst: WorstContact,
    table: RiskTable,
    side: float,
    dispersion: Dispersion,
) -> list[str]:
    """What most of the risk comes from at aim points, as `Remainder.words` has it.

    Args:
        places: Rows and columns (K,) of the lattice.
        risk: (n + 1, n + 1) P(unsafe) of landing at each grid point.
        judged: (n + 1, n + 1) where it follows from ``worst`` by ``table``.
        unmapped: (n + 1, n + 1) where the lander meets ground that is seen but not yet mapped.
        worst, table: As of `RiskTable.risk`.
        side: Between grid points, m.
        dispersion: Of the touchdown about the aim.
    """
    across, along = (
        _middle(normal_weights(sigma, side), count)
        for sigma, count in zip((dispersion.y, dispersion.x), risk.shape, strict=True)
    )
    up, right, within = len(across) // 2, len(along) // 2, float(across.sum() * along.sum())
    found = []
    for at_row, at_column in zip(*(of.tolist() for of in places), strict=True):
        south, west = max(at_row - up, 0), max(at_column - right, 0)
        known = risk[south : at_row + up + 1, west : at_column + right + 1]
        share = across[:, None] * along
        south, west = south - at_row + up, west - at_column + right
        share[south : south + known.shape[0], west : west + known.shape[1]] *= known
        row, column = divmod(int(np.argmax(share)), len(along))
        y, x = (row - up) * side, (column - right) * side
        here = row + at_row - up, column + at_column - right
        inside = 0 <= here[0] < risk.shape[0] and 0 <= here[1] < risk.shape[1]
        kind = "unseen"
        if inside and judged[here]:
            steep = table.by_slope(float(worst.rise[here]), float(worst.slope[here]))
            kind = "slope" if steep else "obstacle"
        elif inside and unmapped[here]:
            kind = "unmapped"
        away, bearing = float(np.hypot(x, y)), float(np.arctan2(y, x))
        found.append(Remainder(within - float(share.sum()), away, bearing, kind).words())
    return found


def _middle(weights: Array, count: int) -> Array:
    """Of `normal_weights` those of points of a lattice of so many, as seen from any of them."""
    beyond = max(len(weights) // 2 - count, 0)
    return weights[beyond : len(weights) - beyond]


@cython.boundscheck(False)
@cython.locals(rise=cython.float[:, ::1], slope=cython.float[:, ::1], judged=cython.uchar[:, ::1])
@cython.locals(rise_odds=cython.double[::1], slope_odds=cython.double[::1], low=cython.double[::1])
@cython.locals(within=cython.double[::1], own=cython.double[:, ::1], about=cython.double[:, ::1])
def set_odds(
    rise: Single,
    slope: Single,
    judged: Bytes,
    rise_odds: Array,
    slope_odds: Array,
    low: Array,
    within: Array,
    own: Array,
    about: Array,
) -> None:
    """Log odds that the lander fails at grid points, and how much greater they are beside them.

    Args:
        rise, slope: (ny, nx) of the worst contact, m and rise over run.
        judged: (ny, nx) where they are known; elsewhere the odds are the least.
        rise_odds, slope_odds: Odds that it fails by the one and by the other, from ``low`` (2,) in
            steps of ``FINE``: 1 + the odds that it fails is (1 + the one's) (1 + the other's).
        within: (2,) least and greatest log odds.
        own: (ny, nx), set.
        about: (ny, nx), set: how much greater those of the worst of the four neighbours are.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(m=cython.Py_ssize_t)
    k_last: cython.Py_ssize_t = -1
    m_last: cython.Py_ssize_t = -1
    rows: cython.Py_ssize_t = own.shape[0]
    columns: cython.Py_ssize_t = own.shape[1]
    rise_last: cython.double = rise_odds.shape[0] - 1.0
    slope_last: cython.double = slope_odds.shape[0] - 1.0
    odds, least, greatest = 0.0, within[0], within[1]
    per = 1.0 / FINE
    with cython.nogil:
        for i in range(rows):
            for j in range(columns):
                if not judged[i, j]:
                    own[i, j] = least
                    continue
                place = min(max((rise[i, j] - low[0]) * per + 0.5, 0.0), rise_last)
                k = cython.cast(cython.Py_ssize_t, place)
                place = min(max((slope[i, j] - low[1]) * per + 0.5, 0.0), slope_last)
                m = cython.cast(cython.Py_ssize_t, place)
                if k != k_last or m != m_last:  # level ground is all alike
                    odds = log(rise_odds[k] + slope_odds[m] + rise_odds[k] * slope_odds[m])
                    odds = min(max(odds, least), greatest)
                    k_last, m_last = k, m
                own[i, j] = odds
        for i in range(rows):
            for j in range(columns):
                worst = own[i, j]
                if i > 0:
                    worst = max(worst, own[i - 1, j])
                if i < rows - 1:
                    worst = max(worst, own[i + 1, j])
                if j > 0:
                    worst = max(worst, own[i, j - 1])
                if j < columns - 1:
                    worst = max(worst, own[i, j + 1])
                about[i, j] = worst - own[i, j]


@cython.boundscheck(False)
@cython.locals(own=cython.double[:, ::1], about=cython.double[:, ::1], judged=cython.uchar[:, ::1])
@cython.locals(table=cython.double[:, ::1], out=cython.double[:, ::1])
def look_up(
    own: Array, about: Array, judged: Bytes, table: Array, least: float, out: Array
) -> None:
    """Set P(unsafe) at grid points (ny, nx) where it is ``judged``.

    ``table`` (K, M) has it by the log odds that `set_odds` gives: of ``own`` from ``least`` and of
    ``about`` from 0, in steps of ``FINE_ODDS``.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    cython.declare(m=cython.Py_ssize_t)
    per = 1.0 / FINE_ODDS
    with cython.nogil:
        for i in range(out.shape[0]):
            for j in range(out.shape[1]):
                if judged[i, j]:
                    k = cython.cast(cython.Py_ssize_t, (own[i, j] - least) * per + 0.5)
                    m = cython.cast(cython.Py_ssize_t, about[i, j] * per + 0.5)
                    out[i, j] = table[min(k, table.shape[0] - 1), min(m, table.shape[1] - 1)]


@cython.boundscheck(False)
@cython.locals(risk=cython.double[:, ::1], across=cython.double[::1], along=cython.double[::1])
@cython.locals(out=cython.double[:, ::1])
def blur(risk: Array, across: Array, along: Array, out: Array) -> None:
    """Weighted means of P(unsafe) about each grid point; beyond the lattice it is 1.

    Args:
        risk: (ny, nx).
        across, along: (K + 1,), (L + 1,) weights of rows and columns so far from the grid point;
            on both sides they are alike. K and L are even.
        out: (ny, nx), set.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, k=cython.Py_ssize_t)
    rows: cython.Py_ssize_t = risk.shape[0]
    columns: cython.Py_ssize_t = risk.shape[1]
    up: cython.Py_ssize_t = across.shape[0] - 1
    right: cython.Py_ssize_t = along.shape[0] - 1
    # Of P(safe): beyond the lattice there is none.
    safe = cython.declare(cython.double[:, ::1], np.zeros((rows + 2 * up, columns)))
    line = cython.declare(cython.double[::1], np.zeros(columns + 2 * right))
    with cython.nogil:
        for i in range(rows):
            for j in range(columns):
                line[right + j] = 1.0 - risk[i, j]
            for j in range(columns):
                safe[up + i, j] = along[0] * line[right + j]
            for k in range(1, right, 2):
                near, far = along[k], along[k + 1]
                for j in range(right, right + columns):
                    z = near * (line[j - k] + line[j + k])
                    z += far * (line[j - k - 1] + line[j + k + 1])
                    safe[up + i, j - right] += z
        for i in range(rows):
            for j in range(columns):
                out[i, j] = 1.0 - across[0] * safe[up + i, j]
            for k in range(1, up, 2):
                near, far = across[k], across[k + 1]
                south: cython.Py_ssize_t = up + i - k
                north: cython.Py_ssize_t = up + i + k
                for j in range(columns):
                    z = near * (safe[south, j] + safe[north, j])
                    z += far * (safe[south - 1, j] + safe[north + 1, j])
                    out[i, j] -= z
            for j in range(columns):
                out[i, j] = min(max(out[i, j], 0.0), 1.0)
