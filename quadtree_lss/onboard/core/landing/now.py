# SPDX-License-Identifier: Apache-2.0
"""The best place within reach at this moment, and what waiting would gain.

Within reach is what lies no farther than `Descent.reach` from where the vehicle comes to rest. The
best is the most probably safe one of the ground that is safe and permitted there; where there is
none, of all that is seen and permitted, whatever its risk.

What is computed of a place, u = 1 - p, is right on average, and after another look it is another by
`DOUBT` u. So no single place gains by waiting, but the choice among K of them does:

    gain = u(best) - E[min over k of L_k],    L_k lognormal of mean u_k and deviation DOUBT u_k,

with those K that are still within reach `WAIT_S` later, if the vehicle goes on as it flies.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import erfc, log, sqrt

import numpy as np

from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.grid import Aims, best_points
from quadtree_lss.onboard.core.landing.hazards import UNSEEN
from quadtree_lss.onboard.core.landing.target import (
    ASIDE,
    DOUBT,
    WAIT_S,
    Descent,
    Motion,
    Restrictions,
)

#: Places that waiting is reckoned with; most grid points a side that are looked at where no ground
#: is safe.
CHOICES, COARSE = 8, 128
#: Deviation of the logarithm of a risk, whose own deviation is `DOUBT` of it.
SPREAD = sqrt(log(1.0 + DOUBT**2))
_normal = np.vectorize(lambda z: 0.5 * erfc(-z / sqrt(2.0)), otypes=[np.float64])


@dataclass(frozen=True)
class Now:
    """What there is within reach.

    Attributes:
        cost: (ny, nx) how bad a grid point is, NaN where it is no choice.
        best: Row and column of the best, None if there is none.
        gain: What `WAIT_S` more are worth, as a probability; NaN if nobody asked for one.
    """

    cost: Array
    best: tuple[int, int] | None = None
    gain: float = float("nan")


def within_reach(
    aims: Aims, wanted: Restrictions, lss: LssConfig, motion: Motion | None, descent: Descent | None
) -> Now:
    """The best that there is now. ``motion``, ``descent``: of the vehicle; without its place all of
    the map is within reach."""
    ground, x, y = aims.candidates, aims.at.x, aims.at.y
    bad = ground.cost if ground.unsafe is None else ground.unsafe
    cost, after = (
        _choices(aims, wanted, lss, reached(x, y, motion, descent, wait)) for wait in (0.0, WAIT_S)
    )
    if not np.isfinite(cost).any():
        return Now(cost)
    if motion is not None and ground.unsafe is not None:
        away = np.hypot(x - motion.x, y[:, None] - motion.y)
        cost += lss.target_risk * np.where(np.isfinite(away), away, 0.0)
    row, column = divmod(int(np.nanargmin(cost)), cost.shape[1])
    if ground.unsafe is None:
        return Now(cost, (row, column))
    places = best_points(after, x, y, CHOICES, lss.separation)
    return Now(cost, (row, column), float(bad[row, column]) - least_later(bad[places]))


def _choices(aims: Aims, wanted: Restrictions, lss: LssConfig, reached: Mask) -> Array:
    """(ny, nx) how bad the grid points are that are a choice of those within reach, else NaN."""
    ground, x, y = aims.candidates, aims.at.x, aims.at.y
    safe = reached & np.isfinite(ground.cost)
    if safe.any() or ground.unsafe is None:
        return np.where(safe, ground.cost if ground.unsafe is None else ground.unsafe, np.nan)
    step, cost = max(len(x) // COARSE, 1), np.full(ground.cost.shape, np.nan)
    part = np.where(aims.hazard & UNSEEN, np.nan, ground.unsafe)[::step, ::step]
    replace(wanted, target=None).apply(part, x[::step], y[::step], lss)
    cost[::step, ::step] = np.where(part < 1.0, part, np.nan)
    return np.where(reached, cost, np.nan)


def least_later(risks: Array) -> float:
    """Expected least of risks (K,) after another look; 1 of none."""
    if not len(risks):
        return 1.0
    middle = np.log(np.maximum(risks, 1e-9)) - 0.5 * SPREAD**2
    at = np.linspace(-8.0 * SPREAD, 8.0 * SPREAD, 65) + float(middle.min())
    greater = np.prod(_normal((middle[:, None] - at) / SPREAD), axis=0) * np.exp(at)
    return float(np.exp(at[0]) + np.sum(0.5 * (greater[1:] + greater[:-1])) * (at[1] - at[0]))


def reached(
    x: Array, y: Array, motion: Motion | None, descent: Descent | None, wait: float
) -> Mask:
    """(ny, nx) whether the vehicle gets there, after going on for ``wait`` seconds."""
    if motion is None or descent is None or not np.isfinite(motion.x):
        return np.ones((len(y), len(x)), dtype=np.bool_)
    left = Descent(descent.height - wait * descent.speed, descent.speed)
    stop = wait + min(0.5 * np.hypot(motion.along_x, motion.along_y) / ASIDE, 0.5 * left.seconds)
    at_x, at_y = motion.x + stop * motion.along_x, motion.y + stop * motion.along_y
    square = (x - at_x) ** 2 + (y[:, None] - at_y) ** 2
    return np.asarray(square <= left.reach**2)
