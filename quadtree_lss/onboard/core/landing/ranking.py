# SPDX-License-Identifier: Apache-2.0
"""The order of landing sites.

The risk model cannot distinguish probabilities whose difference is within its error. Candidates
with such probabilities are equal, and the one with the greatest clearance ranks first.
"""

from __future__ import annotations

from math import inf

import numpy as np

from quadtree_lss.onboard.arrays import Array

#: Standard deviation of the error of a predicted probability p as a share of 1 - p, for the safest
#: grid points on maps of simulated flights (benchmark/target.py --told).
MODEL_ERROR = 0.5
#: Two risks u <= v are equal if v - u <= MODEL_ERROR * hypot(u, v): up to v = 2.2 u ...
EQUAL_RISKS: float = (1.0 + (1.0 - (1.0 - MODEL_ERROR**2) ** 2) ** 0.5) / (1.0 - MODEL_ERROR**2)
#: ... or, however small u is, up to this risk: probabilities are shown as at most 99.99 %.
MIN_RISK = 1e-4
#: The error is that of safe ground: risks that differ by more than this are never equal.
MAX_DIFFERENCE = 0.01


def equal_up_to(risk: float) -> float:
    """Return the highest risk that is equal to a risk."""
    return min(max(EQUAL_RISKS * risk, MIN_RISK), risk + MAX_DIFFERENCE)


def best_among_equals(
    cost: Array, unsafe: Array | None, clearance: Array | None
) -> tuple[int, int] | None:
    """Return row and column of the candidate that ranks first, None without a candidate.

    Among those that are equal to the one with the lowest cost, it is the one with the greatest
    clearance, then with the lowest cost.

    Args:
        cost: (ny, nx) lower is better; NaN or infinite where there is no candidate.
        unsafe: (ny, nx) P(unsafe | aim); None if the cost is not a probability: the lowest cost
            ranks first.
        clearance: (ny, nx) how far the landing zone may move until it touches excluded ground, m;
            None if unknown.
    """
    left = np.fmin(cost, inf).ravel()
    first = int(np.argmin(left))
    if not np.isfinite(left[first]):
        return None
    if unsafe is not None and clearance is not None:
        risk = float(unsafe.flat[first])
        equals = np.flatnonzero(left <= left[first] + equal_up_to(risk) - risk)
        room = clearance.ravel()[equals]
        clearest = equals[room == room.max()]
        first = int(clearest[np.argmin(left[clearest])])
    row, column = divmod(first, cost.shape[1])
    return row, column


def ranked_points(
    cost: Array,
    unsafe: Array | None,
    clearance: Array | None,
    steps: float,
    count: int,
) -> list[tuple[int, int]]:
    """Return row and column of the best candidates (see `best_among_equals`), best first; at most
    ``count``, and at least ``steps`` grid points apart."""
    left = np.fmin(cost, inf)
    best: list[tuple[int, int]] = []
    while len(best) < count and (point := best_among_equals(left, unsafe, clearance)):
        south, west = (max(index - int(steps), 0) for index in point)
        around = left[south : point[0] + int(steps) + 1, west : point[1] + int(steps) + 1]
        row, column = np.ogrid[: around.shape[0], : around.shape[1]]
        apart = (row + south - point[0]) ** 2 + (column + west - point[1]) ** 2
        around[apart < steps**2] = inf
        left[point] = inf
        best.append(point)
    return best
