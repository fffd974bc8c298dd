# SPDX-License-Identifier: Apache-2.0
"""Fits a ``RiskModel`` to counts of landings: how many were tried, how many failed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize
from scipy.sparse import csr_array, kron

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.risk import RiskModel, Row
from quadtree_lss.onboard.core.landing.probability import interpolation_weights

#: Knots of r, m; of s, rise over run; of l, d and g; of h, rad (see ``RiskModel``).
RISE = (-0.15, -0.12, -0.09, -0.06, -0.04, -0.02, 0.0) + (
    *(0.02, 0.04, 0.06, 0.09, 0.12, 0.16, 0.22, 0.35),
)
SLOPE = (-0.08, -0.06, -0.045, -0.03, -0.015, 0.0, 0.015, 0.03, 0.045, 0.06, 0.08, 0.1)
OWN = (-10.0, -8.0, -6.5, -5.0, -4.0, -3.0, -2.0, -1.0, 0.0, 2.0, 4.0, 6.0)
ABOUT = (0.0, 0.5, 1.0, 2.0, 3.5, 6.0)
ROCKS = (-10.4, -7.1, -4.9, -2.8)
UNDULATION = (0.026, 0.06, 0.08)
#: Centres of the bins that landings are counted in.
RISE_BINS = np.linspace(RISE[0], RISE[-1], 201)
SLOPE_BINS = np.linspace(SLOPE[0], SLOPE[-1], 73)
OWN_BINS = np.linspace(OWN[0], OWN[-1], 65)
ABOUT_BINS = np.linspace(ABOUT[0], ABOUT[-1], 25)

#: Weights against the mean log score: of second differences of curves and of tables, of what does
#: not ascend, of differences between one kind of ground and the next, and of what is added to it.
SMOOTH, SMOOTH_TABLES, ASCENDING, ALIKE, SMALL = 2e-6, 5e-8, 1e-3, 1e-9, 1e-8
#: Least and greatest of what a curve may begin with.
LEAST, MOST = -16.0, -2.0


def unfitted() -> RiskModel:
    """Knots without a fit: curves that fail nowhere, and a second step that changes nothing."""
    table = tuple((own,) * len(ABOUT) for own in OWN)
    none = ((0.0,) * len(ABOUT),) * len(OWN)
    return RiskModel(
        rise=RISE,
        rise_odds=(LEAST,) * len(RISE),
        slope=SLOPE,
        slope_odds=(LEAST,) * len(SLOPE),
        own=OWN,
        about=ABOUT,
        rocks=ROCKS,
        odds=(table,) * len(ROCKS),
        undulation=UNDULATION,
        undulating=(none,) * (len(UNDULATION) - 1),
        noise=(0.0, 1.0),
        noisy=none,
    )


def counted(
    first: ArrayLike, second: ArrayLike, failed: ArrayLike, bins: tuple[Array, Array]
) -> Array:
    """Landings tried and failed (2, len(bins[0]), len(bins[1])), in the nearest bins.

    Args:
        first, second: (K,) what they are counted by.
        failed: (K,) whether they did.
        bins: Centres, evenly spaced; what lies beyond the last counts for it.
    """
    place = []
    for values, centres in zip((first, second), bins, strict=True):
        step = (centres[-1] - centres[0]) / (len(centres) - 1)
        nearest = np.rint((np.asarray(values, float) - centres[0]) / step)
        place.append(np.clip(nearest, 0, len(centres) - 1).astype(np.intp))
    at = place[0] * len(bins[1]) + place[1]
    of = np.asarray(failed, float)
    tried = np.bincount(at, minlength=len(bins[0]) * len(bins[1]))
    return np.stack([tried, np.bincount(at, of, len(tried))]).reshape(2, len(bins[0]), -1)


def fit_curves(counts: Array) -> tuple[Row, Row]:
    """First step: a at the knots of r and b at those of s, which ascend.

    Args:
        counts: (2, R, S) weights of the landings tried and failed, over the bins of r and s.
    """
    tried, failed = counts / counts[0].sum()
    by_rise = interpolation_weights(RISE_BINS, RISE)
    by_slope = interpolation_weights(SLOPE_BINS, SLOPE)
    # What is sought are steps from knot to knot, none of them down.
    up_r, up_s = by_rise @ _sums(len(RISE)), by_slope @ _sums(len(SLOPE))
    bend_r = np.diff(_sums(len(RISE)), 2, axis=0)
    bend_s = np.diff(_sums(len(SLOPE)), 2, axis=0)

    def cost(steps: Array) -> tuple[float, Array]:
        one, other = steps[: len(RISE)], steps[len(RISE) :]
        odds_r, odds_s = up_r @ one, up_s @ other
        safe = -np.logaddexp(0.0, odds_r)[:, None] - np.logaddexp(0.0, odds_s)
        safe = np.minimum(safe, -1e-12)
        risk = -np.expm1(safe)
        slope = tried - failed - failed * (1.0 - risk) / risk  # of the cost, by -log P(safe)
        value = -np.sum(failed * np.log(risk) + (tried - failed) * safe)
        by_r = up_r.T @ (slope.sum(1) / (1.0 + np.exp(-odds_r)))
        by_s = up_s.T @ (slope.sum(0) / (1.0 + np.exp(-odds_s)))
        bent_r, bent_s = bend_r @ one, bend_s @ other
        value += SMOOTH * (bent_r @ bent_r + bent_s @ bent_s)
        by_r += 2.0 * SMOOTH * bend_r.T @ bent_r
        by_s += 2.0 * SMOOTH * bend_s.T @ bent_s
        return float(value), np.concatenate([by_r, by_s])

    begin = np.concatenate([[-7.0], np.full(len(RISE) - 1, 0.7), [-7.0], [0.7] * (len(SLOPE) - 1)])
    bounds = [(LEAST, MOST), *[(0.0, None)] * (len(RISE) - 1)]
    bounds += [(LEAST, MOST), *[(0.0, None)] * (len(SLOPE) - 1)]
    steps = _least(cost, begin, bounds)
    return rounded(np.cumsum(steps[: len(RISE)])), rounded(np.cumsum(steps[len(RISE) :]))


def fit_tables(shares: Array, counts: Array) -> Array:
    """Second step: tables (G + H, I, J) of the log odds at the knots of l and d, c, m and n.

    Tables c ascend with l and d as good as always.

    Args:
        shares: (M, G + H) what the tables weigh on each map (see ``RiskTable.shares``).
        counts: (M, 2, L, D) weights of its landings tried and failed, over the bins of l and d.
    """
    maps, kinds, size = len(shares), len(ROCKS), len(OWN) * len(ABOUT)
    tried, failed = np.swapaxes(counts, 0, 1).reshape(2, maps, -1) / counts[:, 0].sum()
    here = tried > 0.0
    tried, failed = tried[here], failed[here]
    place = np.kron(interpolation_weights(OWN_BINS, OWN), interpolation_weights(ABOUT_BINS, ABOUT))
    tables = np.eye(shares.shape[1])
    alike = np.vstack(
        [np.sqrt(ALIKE) * np.diff(tables[:kinds], axis=0), np.sqrt(SMALL) * tables[kinds:]]
    )

    def differences(axis: int, order: int, of: Array) -> csr_array:
        by = [np.eye(len(OWN)), np.eye(len(ABOUT))]
        by[axis] = np.diff(by[axis], order, axis=0)
        return csr_array(kron(of, kron(by[0], by[1])))

    squares = [
        (SMOOTH_TABLES, differences(0, 2, tables)),
        (SMOOTH_TABLES, differences(1, 2, tables)),
        (1.0, csr_array(kron(alike, np.eye(size)))),
    ]
    rises = [differences(axis, 1, tables[:kinds]) for axis in (0, 1)]
    more = np.zeros(here.shape)

    def cost(odds: Array) -> tuple[float, Array]:
        at = (shares @ odds.reshape(-1, size) @ place.T)[here]
        value = float(np.sum(tried * np.logaddexp(0.0, at) - failed * at))
        more[here] = tried / (1.0 + np.exp(-at)) - failed
        by = np.ravel(shares.T @ more @ place)
        for weight, matrix in squares:
            bent = matrix @ odds
            value, by = value + weight * float(bent @ bent), by + 2.0 * weight * matrix.T @ bent
        for matrix in rises:
            down = np.minimum(matrix @ odds, 0.0)
            value += ASCENDING * float(down @ down)
            by = by + 2.0 * ASCENDING * matrix.T @ down
        return value, by

    begin = np.zeros((len(tables), len(OWN), len(ABOUT)))
    begin[:kinds] = np.array(OWN)[:, None]
    return _least(cost, begin.ravel(), None).reshape(begin.shape)


def _least(
    cost: Callable[[Array], tuple[float, Array]],
    begin: Array,
    bounds: list[tuple[float, float | None]] | None,
) -> Array:
    options = {"maxiter": 5000, "maxfun": 8000, "ftol": 1e-13, "gtol": 1e-9}
    found = minimize(cost, begin, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return np.asarray(found.x)


def _sums(count: int) -> Array:
    return np.tril(np.ones((count, count)))


def rounded(values: Array) -> Row:
    """As it is written into a file."""
    return tuple(round(float(value), 3) for value in values)
