# SPDX-License-Identifier: Apache-2.0
"""The grid points where landing is permitted, and their order.

The risk model cannot distinguish probabilities whose difference is within its error. Grid points
with such probabilities are equal, and the one with the greatest clearance ranks first.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from functools import cached_property
from math import inf

import numpy as np

from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.core.tree.domain import carried

#: Standard deviation of the error of a predicted probability p as a share of 1 - p, for the safest
#: grid points on maps of simulated flights (benchmark/target.py --predicted).
MODEL_ERROR = 0.5
#: Two risks u <= v are equal if v - u <= MODEL_ERROR * hypot(u, v): up to v = 2.2 u ...
EQUAL_RISKS: float = (1.0 + (1.0 - (1.0 - MODEL_ERROR**2) ** 2) ** 0.5) / (1.0 - MODEL_ERROR**2)
#: ... or, however small u is, up to this risk: probabilities are shown as at most 99.99 %.
MIN_RISK = 1e-4
#: The error is that of safe ground: risks that differ by more than this are never equal.
MAX_DIFFERENCE = 0.01
#: Tolerance of equal coordinates as a share of the grid's spacing, for rounding.
COORDINATE_TOLERANCE = 1e-6

GridIndex = tuple[int, int]


def equal_up_to(risk: float) -> float:
    """Return the highest risk that is equal to a risk."""
    return min(max(EQUAL_RISKS * risk, MIN_RISK), risk + MAX_DIFFERENCE)


@dataclass(frozen=True)
class Candidates:
    """Grid points of an assessment where landing is permitted.

    Attributes:
        x, y: (nx,), (ny,) of the grid points, m.
        safe: (ny, nx) the ground allows landing.
        cost: (ny, nx) lower is better; NaN where the ground or a restriction excludes landing.
        risk: (ny, nx) predicted risk of a touchdown exactly there; NaN without a risk model.
        unsafe: (ny, nx) P(unsafe | aim); None with ranking by score.
        clearance: (ny, nx) how far the landing zone may move until it touches excluded ground, m;
            None if unknown.
    """

    x: Array
    y: Array
    safe: Mask
    cost: Array
    risk: Array
    unsafe: Array | None = None
    clearance: Array | None = None

    @cached_property
    def permitted(self) -> Mask:
        """Return (ny, nx) where landing is permitted."""
        return np.isfinite(self.cost)

    @cached_property
    def best(self) -> GridIndex | None:
        """Return row and column of the grid point that ranks first, None without one."""
        return self.rank_first(np.fmin(self.cost, inf))

    def rank_first(self, cost: Array) -> GridIndex | None:
        """Return the same by another cost (ny, nx), infinite where excluded."""
        left = cost.ravel()
        first = int(np.argmin(left))
        if not np.isfinite(left[first]):
            return None
        if self.unsafe is not None and self.clearance is not None:
            risk = float(self.unsafe.flat[first])
            equals = np.flatnonzero(left <= left[first] + equal_up_to(risk) - risk)
            clearance = self.clearance.ravel()[equals]
            clearest = equals[clearance == clearance.max()]
            first = int(clearest[np.argmin(left[clearest])])
        row, column = divmod(first, cost.shape[1])
        return row, column

    def ranked(self, apart: float, count: int) -> list[GridIndex]:
        """Return row and column of the best ones, best first: at most ``count``, and at least
        ``apart``, m, from each other."""
        left = np.fmin(self.cost, inf)
        steps = apart / (self.x[1] - self.x[0]) if len(self.x) > 1 else 0.0
        best: list[GridIndex] = []
        while len(best) < count and (point := self.rank_first(left)):
            south, west = (max(index - int(steps), 0) for index in point)
            around = left[south : point[0] + int(steps) + 1, west : point[1] + int(steps) + 1]
            row, column = np.ogrid[: around.shape[0], : around.shape[1]]
            away = (row + south - point[0]) ** 2 + (column + west - point[1]) ** 2
            around[away < steps**2] = inf
            left[point] = inf
            best.append(point)
        return best

    def probable(self, least: float) -> Mask:
        """Return (ny, nx) where landing is permitted and succeeds with probability ``least``."""
        if self.unsafe is None:
            return self.permitted
        return self.permitted & ~(self.unsafe > 1.0 - least)

    def find(self, x: float, y: float) -> GridIndex | None:
        """Return row and column of the grid point at x and y, m, None if there is none."""
        slack = COORDINATE_TOLERANCE * float(self.x[1] - self.x[0]) if len(self.x) > 1 else 0.0
        row, column = bisect_left(self.y, y - slack), bisect_left(self.x, x - slack)
        found = row < len(self.y) and column < len(self.x)
        found = found and self.y[row] <= y + slack and self.x[column] <= x + slack
        return (row, column) if found else None

    def safe_on(self, other: Candidates) -> Mask:
        """Return `safe` at the grid points of another grid, which may be this one moved by whole
        steps; False at new grid points."""
        if np.array_equal(self.x, other.x) and np.array_equal(self.y, other.y):
            return self.safe
        nowhere = np.zeros_like(other.safe)
        if self.safe.shape != nowhere.shape or min(nowhere.shape) < 2:
            return nowhere
        moved = other.x[0] - self.x[0], other.y[0] - self.y[0]
        steps = np.array(moved) / (self.x[1] - self.x[0], self.y[1] - self.y[0])
        east, north = np.round(steps).astype(int).tolist()
        whole = np.abs(steps - (east, north)).max() <= COORDINATE_TOLERANCE
        return carried(self.safe, east, north, False) if whole else nowhere
