# SPDX-License-Identifier: Apache-2.0
"""The user's grid: its points as aims, the best of them, and the best within reach.

A grid point is within reach if it lies no farther than `Descent.reach` from where the vehicle
stops. The best is the permitted and safe grid point with the highest probability of success; if
there is none, the best of all observed and permitted ground.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import isfinite
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Mask
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.hazards import UNSEEN
from quadtree_lss.onboard.core.landing.probability import Dispersion, aimed
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.landing.restrictions import Restrictions
from quadtree_lss.onboard.core.landing.score import PointAssessment
from quadtree_lss.onboard.core.landing.target import (
    ASIDE,
    NEARER,
    Candidates,
    Descent,
    Motion,
)
from quadtree_lss.onboard.core.tree.domain import Domain

#: The most that the score weighs against a probability: it decides where these are the same.
TIE = 1e-5
#: Most grid points per side that are evaluated where no ground is safe.
COARSE = 128
Kind = TypeVar("Kind", bound=np.generic)


class GridSampler:
    """Values on the finest lattice seen from the user's grid.

    A grid point that coincides with one of the lattice takes its value; one between them is judged
    by all (up to four) around it. ``x``, ``y``: (nx,), (ny,) of the grid points, m.
    """

    def __init__(self, domain: Domain, x: Array, y: Array) -> None:
        n, side = domain.finest_count, domain.finest_size
        self.x, self.y = x, y
        self.column = np.clip((x - domain.xmin) / side, 0.0, n)
        self.row = np.clip((y - domain.ymin) / side, 0.0, n)
        low = [np.floor(place + 1e-6).astype(np.intp) for place in (self.row, self.column)]
        high = [np.ceil(place - 1e-6).astype(np.intp) for place in (self.row, self.column)]
        self.u = np.clip(self.column - low[1], 0.0, 1.0)
        self.v = np.clip(self.row - low[0], 0.0, 1.0)[:, None]
        self.on_lattice = all((a == b).all() for a, b in zip(low, high, strict=True))
        self.low = tuple(_steps(index) for index in low)
        self.high = tuple(_steps(index) for index in high)
        self.near = (
            np.where(self.v[:, 0] < 0.5, low[0], high[0]),
            np.where(self.u < 0.5, low[1], high[1]),
        )
        self.nearest_to = tuple(_steps(index) for index in self.near)
        self.cell = tuple(_steps(np.minimum(index, n - 1)) for index in low)

    def _corners(self, values: NDArray[Kind]) -> tuple[NDArray[Kind], ...]:
        """Values of the four lattice points around, or of the one that coincides."""
        low, high = self.low, self.high
        if self.on_lattice:
            return (values[low[0]][:, low[1]],)
        south, north = values[low[0]], values[high[0]]
        return south[:, low[1]], south[:, high[1]], north[:, low[1]], north[:, high[1]]

    def everywhere(self, values: Mask) -> Mask:
        """True where all surrounding lattice points are."""
        return np.asarray(np.logical_and.reduce(self._corners(values)), dtype=np.bool_)

    def any(self, values: Bytes) -> Bytes:
        """Bits set in any surrounding lattice point."""
        return np.asarray(np.bitwise_or.reduce(self._corners(values)), dtype=np.uint8)

    def nearest(self, values: Array) -> Array:
        """Value of the nearest lattice point."""
        return values[self.nearest_to[0]][:, self.nearest_to[1]]

    def lattice(self, rows: Index, columns: Index) -> tuple[Index, Index]:
        """Row and column of the lattice points nearest to grid points (K,)."""
        return self.near[0][rows], self.near[1][columns]

    def linear(self, values: Array) -> Array:
        """Bilinear interpolation."""
        corners = self._corners(values)
        if self.on_lattice:
            return corners[0]
        a, b, c, d = corners
        u, v = self.u, self.v
        out: Array = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
        return out

    def ground(self, raster: TerrainRaster) -> Array:
        """Height of the map, m: of the plane over the finest cell that a grid point lies in.

        A point on a border belongs to the cell north and east of it, as measurements do.
        """
        cell, domain, cells = self.cell, raster.domain, raster.cells
        leaf = raster.leaf[cell[0]][:, cell[1]]
        x = domain.xmin + self.column * domain.finest_size
        y = domain.ymin + self.row * domain.finest_size
        heights = cells.heights(leaf, x, y[:, None])
        bridged, borrowed = (of[cell[0]][:, cell[1]] for of in (raster.bridged, raster.elevation))
        return np.where(bridged, borrowed, heights)


@dataclass(frozen=True)
class Aims:
    """The points of the user's grid as aims, (ny, nx).

    Attributes:
        at: The grid.
        score: Eq. 59, NaN where excluded.
        probability: Of a safe touchdown; NaN if nobody asked for it.
        risk: That landing right there fails; NaN if nobody asked for it.
        hazard: Bits of ``hazards``.
        candidates: What sites are chosen from.
        withheld: Why no site may be given out and all is excluded; empty if that is not so.
    """

    at: GridSampler
    score: Array
    probability: Array
    risk: Array
    hazard: Bytes
    candidates: Candidates
    withheld: str

    def without(self, places: Mask) -> Aims:
        """None of these, (ny, nx), is permitted."""
        if not places.any():
            return self
        cost = np.where(places, np.nan, self.candidates.cost)
        score, unsafe = np.where(places, np.nan, self.score), self.candidates.unsafe
        unsafe = unsafe if unsafe is None else np.where(places, 1.0, unsafe)
        found = replace(self.candidates, cost=cost, unsafe=unsafe)
        return replace(self, score=score, candidates=found)


def aim(
    points: PointAssessment,
    at: GridSampler,
    spread: Dispersion,
    wanted: Restrictions,
    lss: LssConfig,
) -> Aims:
    """Evaluate the points of the user's grid as aims: the risk over where the lander comes down."""
    at_aim, ranks = points.risk, lss.ranking == "probability"
    if ranks:
        at_aim = aimed(at_aim, points.raster.domain.finest_size, spread)
    unsafe, safe = at.linear(at_aim), at.everywhere(points.safe)
    score = np.where(safe, at.nearest(points.score), np.nan)
    cost = probable_first(unsafe, score) if ranks else score
    hazard, risk = at.any(points.hazard), at.linear(points.risk)
    withheld = wanted.apply(cost, at.x, at.y, lss)
    if ranks and (withheld or wanted.area is not None or len(wanted.keep_outs)):
        np.copyto(score, np.nan, where=np.isnan(cost))
    clearance = at.nearest(points.clearance)
    unsafe_aim = unsafe if ranks else None
    candidates = Candidates(at.x, at.y, safe, cost, unsafe_aim, risk, clearance)
    return Aims(at, score, 1.0 - unsafe, risk, hazard, candidates, withheld)


def probable_first(unsafe: Array, score: Array) -> Array:
    """Costs by P(unsafe | aim), and by the score, whatever it is, where that is equal to `TIE`."""
    return unsafe + 0.5 * TIE * score / (1.0 + np.abs(score))


def within_reach(
    aims: Aims, wanted: Restrictions, lss: LssConfig, motion: Motion | None, descent: Descent | None
) -> Candidates:
    """Return the candidates within reach; without the vehicle's position all grid points are.

    If none of them is both permitted and safe, observed and permitted grid points take part.
    """
    ground, x, y = aims.candidates, aims.at.x, aims.at.y
    cost = _choices(aims, wanted, lss, reached(x, y, motion, descent))
    if motion is not None and ground.unsafe is not None and isfinite(motion.x + motion.y):
        away = np.zeros_like(cost)
        np.hypot(x - motion.x, y[:, None] - motion.y, out=away, where=np.isfinite(cost))
        cost += NEARER["probability"] * away
    return replace(ground, cost=cost)


def _choices(aims: Aims, wanted: Restrictions, lss: LssConfig, reached: Mask) -> Array:
    """(ny, nx) how bad the grid points are that are a choice of those within reach, else NaN."""
    ground, x, y = aims.candidates, aims.at.x, aims.at.y
    safe = reached & ground.permitted
    if safe.any() or ground.unsafe is None:
        return np.where(safe, ground.cost if ground.unsafe is None else ground.unsafe, np.nan)
    step, cost = max(len(x) // COARSE, 1), np.full(ground.cost.shape, np.nan)
    part = np.where(aims.hazard & UNSEEN, np.nan, ground.unsafe)[::step, ::step]
    replace(wanted, target=None).apply(part, x[::step], y[::step], lss)
    cost[::step, ::step] = np.where(part < 1.0, part, np.nan)
    return np.where(reached, cost, np.nan)


def reached(x: Array, y: Array, motion: Motion | None, descent: Descent | None) -> Mask:
    """Return (ny, nx) whether the vehicle can land at each grid point."""
    if motion is None or descent is None or not np.isfinite(motion.x):
        return np.ones((len(y), len(x)), dtype=np.bool_)
    stop = min(0.5 * np.hypot(motion.along_x, motion.along_y) / ASIDE, 0.5 * descent.seconds)
    at_x, at_y = motion.x + stop * motion.along_x, motion.y + stop * motion.along_y
    square = (x - at_x) ** 2 + (y[:, None] - at_y) ** 2
    return np.asarray(square <= descent.reach**2)


@lru_cache(maxsize=4)
def users_grid(domain: Domain, spacing: float) -> GridSampler:
    """Grid points from the domain's south-western corner on in steps of ``spacing``, m, to the far
    edges.

    Assessments share them: they cannot be written to.
    """
    steps = np.arange(int(np.floor(domain.size / spacing + 1e-9)) + 1, dtype=np.float64)
    x, y = domain.xmin + spacing * steps, domain.ymin + spacing * steps
    x.flags.writeable = y.flags.writeable = False
    return GridSampler(domain, x, y)


def _steps(index: Index) -> Index | slice:
    """The same index as a slice, if its steps are even."""
    if len(index) < 2 or (step := int(index[1] - index[0])) < 1:
        return index
    return (
        slice(int(index[0]), int(index[-1]) + 1, step) if (np.diff(index) == step).all() else index
    )
