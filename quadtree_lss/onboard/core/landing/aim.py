# SPDX-License-Identifier: Apache-2.0
"""Step 4 of an assessment: the points of the user's grid as aim points.

The touchdown is normally distributed about the aim point, so

    P(success | aim) = sum over grid points of N(point - aim; dispersion) (1 - risk(point)).

A grid point is within reach if it lies no farther than `Descent.reach` from where the vehicle can
stop.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from math import ceil, isfinite, isnan, nan
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Mask
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.hazards import UNSEEN
from quadtree_lss.onboard.core.landing.lattice import blur
from quadtree_lss.onboard.core.landing.ranking import Candidates
from quadtree_lss.onboard.core.landing.raster import TerrainRaster
from quadtree_lss.onboard.core.landing.restrictions import Restrictions
from quadtree_lss.onboard.core.landing.score import PointAssessment
from quadtree_lss.onboard.core.landing.target import (
    DISTANCE_COST,
    LATERAL_ACCELERATION,
    Descent,
    Motion,
)
from quadtree_lss.onboard.core.tree.domain import Domain

#: Range of the score's contribution to a cost that is a probability: it orders equal probabilities.
SCORE_RANGE = 1e-5
#: Most grid points per side that are searched within reach if none is safe.
MAX_SEARCH_POINTS = 128
#: Ground higher above the vehicle than its diameter and this bound of the drift of navigation's
#: height is excluded, m.
NAVIGATION_DRIFT = 1.0
#: Standard deviations at which the normal distribution of the touchdown is truncated.
TRUNCATION = 4.0
#: Greatest accepted standard deviation of the touchdown, m.
MAX_DISPERSION = 100.0
Kind = TypeVar("Kind", bound=np.generic)


@dataclass(frozen=True)
class Dispersion:
    """Distribution of the touchdown about the aim point: standard deviations along the axes of the
    map, m, and heading of the vehicle, about z from x, rad, None for any."""

    x: float
    y: float
    heading: float | None = None

    @staticmethod
    def from_values(values: ArrayLike | None, lss: LssConfig) -> Dispersion:
        """Check standard deviations along x and y, m, and optionally a heading, rad, NaN for any.

        None: the configured dispersion. Raises `ValueError` for other values."""
        if values is None:
            return Dispersion(lss.dispersion, lss.dispersion)
        given = np.asarray(values, dtype=np.float64)
        sigmas = given[:2]
        usable = (0.0 <= sigmas) & (sigmas <= MAX_DISPERSION)
        if given.shape not in ((2,), (3,)) or not usable.all():
            msg = f"a dispersion needs two standard deviations from 0 to {MAX_DISPERSION:g} m, got"
            raise ValueError(f"{msg} {values!r}")
        heading = float(given[2]) if len(given) == 3 else nan
        return Dispersion(float(given[0]), float(given[1]), heading if isfinite(heading) else None)


class GridSampler:
    """Samples values of the finest lattice at the points of the user's grid.

    A grid point that coincides with a lattice point has its value; others depend on the two or four
    surrounding lattice points. ``x``, ``y``: (nx,), (ny,), m. ``nearest_row``, ``nearest_column``:
    (ny,), (nx,) of the lattice point nearest to each.
    """

    def __init__(self, domain: Domain, x: Array, y: Array) -> None:
        n, side = domain.finest_count, domain.finest_size
        self.x, self.y = x, y
        self._column = np.clip((x - domain.xmin) / side, 0.0, n)
        self._row = np.clip((y - domain.ymin) / side, 0.0, n)
        indices = self._row, self._column
        low = [np.floor(index + 1e-6).astype(np.intp) for index in indices]
        high = [np.ceil(index - 1e-6).astype(np.intp) for index in indices]
        self._u = np.clip(self._column - low[1], 0.0, 1.0)
        self._v = np.clip(self._row - low[0], 0.0, 1.0)[:, None]
        self._on_lattice = all((a == b).all() for a, b in zip(low, high, strict=True))
        self.nearest_row = np.where(self._v[:, 0] < 0.5, low[0], high[0])
        self.nearest_column = np.where(self._u < 0.5, low[1], high[1])
        self._nearest = _as_slice(self.nearest_row), _as_slice(self.nearest_column)
        self._low, self._high = [_as_slice(k) for k in low], [_as_slice(k) for k in high]
        self._cell = [_as_slice(np.minimum(index, n - 1)) for index in low]

    def _corners(self, values: NDArray[Kind]) -> list[NDArray[Kind]]:
        """Return values of the four surrounding lattice points, or of the one that coincides."""
        if self._on_lattice:
            return [values[self._low[0]][:, self._low[1]]]
        sides = self._low, self._high
        return [values[south[0]][:, west[1]] for south in sides for west in sides]

    def all(self, values: Mask) -> Mask:
        """Return where all surrounding lattice points are True."""
        return np.asarray(np.logical_and.reduce(self._corners(values)), dtype=np.bool_)

    def any(self, values: Bytes) -> Bytes:
        """Return the bits that are set at any surrounding lattice point."""
        return np.asarray(np.bitwise_or.reduce(self._corners(values)), dtype=np.uint8)

    def nearest(self, values: Array) -> Array:
        """Return the values of the nearest lattice points."""
        return values[self._nearest[0]][:, self._nearest[1]]

    def linear(self, values: Array) -> Array:
        """Interpolate bilinearly."""
        corners = self._corners(values)
        if self._on_lattice:
            return corners[0]
        a, b, c, d = corners
        u, v = self._u, self._v
        out: Array = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
        return out

    def leaf_elevation(self, raster: TerrainRaster) -> Array:
        """Return the height of the leaf's plane at each grid point, m.

        A point on a border belongs to the cell to the north-east, as measurements do.
        """
        (rows, columns), domain = self._cell, raster.domain
        bridged, elevation = (
            values[rows][:, columns] for values in (raster.bridged, raster.elevation)
        )
        x = domain.xmin + self._column * domain.finest_size
        y = domain.ymin + self._row * domain.finest_size
        heights = raster.cells.heights(raster.leaf[rows][:, columns], x, y[:, None])
        return np.where(bridged, elevation, heights)


@lru_cache(maxsize=4)
def make_grid(domain: Domain, spacing: float) -> GridSampler:
    """Return the grid points in steps of ``spacing``, m, from the domain's south-western corner;
    assessments share the read-only result."""
    steps = np.arange(int(np.floor(domain.size / spacing + 1e-9)) + 1, dtype=np.float64)
    x, y = domain.xmin + spacing * steps, domain.ymin + spacing * steps
    x.flags.writeable = y.flags.writeable = False
    return GridSampler(domain, x, y)


def _as_slice(index: Index) -> Index | slice:
    """Convert an index with even steps to a slice."""
    if len(index) < 2 or (step := int(index[1] - index[0])) < 1 or (np.diff(index) != step).any():
        return index
    return slice(int(index[0]), int(index[-1]) + 1, step)


@dataclass(frozen=True)
class Aims:
    """The points of the user's grid as aim points, (ny, nx), and the restrictions on them.

    Attributes:
        grid: The grid.
        dispersion: Distribution of the touchdown.
        restrictions: Where landing is wanted.
        elevation: Height of the ground at the vehicle's scale, m.
        score: Eq. 59, NaN where excluded.
        probability: Probability of success; NaN without a risk model.
        hazard: Bits of ``hazards``.
        above: Observed ground that is excluded because it lies above the vehicle.
        descent: Of the vehicle to the target, or to the mean of all ground; None if unknown.
        candidates: Grid points from which sites are chosen.
        now: Candidates within reach at this moment (see `within_reach`).
    """

    grid: GridSampler
    dispersion: Dispersion
    restrictions: Restrictions
    elevation: Array
    score: Array
    probability: Array
    hazard: Bytes
    above: Mask
    descent: Descent | None
    candidates: Candidates
    now: Candidates


def aim(
    points: PointAssessment,
    dispersion: Dispersion,
    restrictions: Restrictions,
    motion: Motion | None,
    held: tuple[float, float] | None,
    lss: LssConfig,
) -> Aims:
    """Evaluate the points of the user's grid as aim points; ``motion``: of the vehicle by the
    map's height; ``held``: x and y of the target, m; each None if there is none."""
    grid = make_grid(points.raster.domain, lss.spacing)
    raster, by_probability = points.raster, lss.ranking == "probability"
    safe = grid.all(points.safe)
    score = np.where(safe, grid.nearest(points.score), np.nan)
    unsafe, cost = np.full(score.shape, np.nan), score.copy()
    if by_probability:  # the score orders equal probabilities
        unsafe = grid.linear(unsafe_aims(points.risk, raster.domain.finest_size, dispersion))
        cost = unsafe + 0.5 * SCORE_RANGE * score / (1.0 + np.abs(score))
    hazard, risk = grid.any(points.hazard), grid.linear(points.risk)
    restrictions.apply_to(cost, grid.x, grid.y, lss)
    probability = 1.0 - unsafe
    elevation, above = grid.linear(raster.planes.elevation), np.zeros_like(safe)
    if motion is not None:
        above = elevation > motion.z + NAVIGATION_DRIFT + lss.vehicle.diameter
        above &= hazard & UNSEEN == 0
        cost[above] = np.nan
        unsafe = np.where(above, 1.0, unsafe)
    score[np.isnan(cost)] = np.nan
    clearance, aim_risk = grid.nearest(points.clearance), unsafe if by_probability else None
    candidates = Candidates(grid.x, grid.y, safe, cost, risk, aim_risk, clearance)
    descent = None if motion is None else remaining_descent(points, grid, motion, held)
    now = within_reach(candidates, points, grid, hazard, restrictions, motion, lss)
    return Aims(
        grid, dispersion, restrictions, elevation, score, probability, hazard, above, descent,
        candidates, now,
    )  # fmt: skip


def unsafe_aims(risk: Array, side: float, dispersion: Dispersion) -> Array:
    """Compute P(unsafe | aim) for each grid point as aim point.

    ``risk``: (ny, nx) at the grid points; beyond them it is 1. ``side``: their distance, m.
    """
    out, possible = np.ones(risk.shape), risk < 1.0
    weights, window = touchdown_weights(risk.shape, side, dispersion), []
    for axis in (0, 1):
        reach = len(weights[axis]) // 2
        found = np.flatnonzero(possible.any(axis=1 - axis))
        if not len(found):
            return out
        window.append(slice(max(int(found[0]) - reach, 0), int(found[-1]) + reach + 1))
    means = np.asarray(risk[tuple(window)], dtype=np.float32)
    for along in reversed(weights):
        reach = len(along) // 2
        means = blur(np.pad(means, ((0, 0), (reach, reach + 3)), constant_values=1.0), along)
    out[tuple(window)] = np.minimum(means, 1.0)
    return out


def touchdown_weights(shape: tuple[int, ...], side: float, dispersion: Dispersion) -> list[Array]:
    """Return the weights of the grid points along y and along x, (2 K + 1,) each: of truncated
    normal distributions, and within a grid of a ``shape``. ``side``: distance of the points, m."""
    out = []
    for sigma, count in zip((dispersion.y / side, dispersion.x / side), shape, strict=True):
        reach = ceil(TRUNCATION * sigma)
        # A smaller standard deviation has the same weights, and no square that overflows.
        weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(sigma, 1e-3)) ** 2)
        beyond = max(reach - count, 0)
        out.append(np.asarray(weights[beyond : len(weights) - beyond] / weights.sum()))
    return out


def within_reach(
    candidates: Candidates,
    points: PointAssessment,
    grid: GridSampler,
    hazard: Bytes,
    restrictions: Restrictions,
    motion: Motion | None,
    lss: LssConfig,
) -> Candidates:
    """Return the candidates within reach; all of them if the vehicle's position is unknown.

    If none of them is permitted and safe, all observed and permitted grid points are candidates.
    """
    x, y, unsafe = grid.x, grid.y, candidates.unsafe
    reached = np.ones_like(candidates.safe)
    if motion is not None and isfinite(motion.x):
        descent = remaining_descent(points, grid, motion, (motion.x, motion.y))
        speed = np.hypot(motion.along_x, motion.along_y)
        stop = min(0.5 * speed / LATERAL_ACCELERATION, 0.5 * descent.seconds)
        stop_x, stop_y = motion.x + stop * motion.along_x, motion.y + stop * motion.along_y
        reached = (x - stop_x) ** 2 + (y[:, None] - stop_y) ** 2 <= descent.reach**2
    safe = reached & candidates.permitted
    if unsafe is None:
        return replace(candidates, cost=np.where(safe, candidates.cost, np.nan))
    if safe.any():
        cost = np.where(safe, unsafe, np.nan)
    else:
        step, cost = max(len(x) // MAX_SEARCH_POINTS, 1), np.full(safe.shape, np.nan)
        part = np.where(hazard & UNSEEN, np.nan, unsafe)[::step, ::step]
        replace(restrictions, target=None).apply_to(part, x[::step], y[::step], lss)
        cost[::step, ::step] = np.where(part < 1.0, part, np.nan)
        cost[~reached] = np.nan
    if motion is not None and isfinite(motion.x + motion.y):
        away = np.zeros_like(cost)
        np.hypot(x - motion.x, y[:, None] - motion.y, out=away, where=np.isfinite(cost))
        cost += DISTANCE_COST["probability"] * away
    return replace(candidates, cost=cost)


def remaining_descent(
    points: PointAssessment, grid: GridSampler, motion: Motion, position: tuple[float, float] | None
) -> Descent:
    """Return the descent to the ground at a position (x, y), m, or to the mean of all ground if the
    ground there is unknown."""
    raster, ground = points.raster, nan
    x, y = position or (nan, nan)
    if grid.x[0] <= x <= grid.x[-1] and grid.y[0] <= y <= grid.y[-1]:
        row = grid.nearest_row[np.abs(grid.y - y).argmin()]
        column = grid.nearest_column[np.abs(grid.x - x).argmin()]
        if raster.observed[max(row - 1, 0) : row + 1, max(column - 1, 0) : column + 1].any():
            ground = float(raster.planes.elevation[row, column])
    if isnan(ground):
        ground = float(np.mean(raster.elevation[raster.observed]))
    return Descent(motion.z - ground, motion.down)
