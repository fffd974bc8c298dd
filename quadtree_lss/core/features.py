# SPDX-License-Identifier: Apache-2.0
"""Subscale features: one bell-shaped bump in a leaf, smaller than the leaf (paper V.C).

Height above the cell's plane is A + p exp(-r^2 / 2 sigma^2) with peak p = k^2 / (2 pi sigma^2), so
that k^2 is the bump's volume (Eq. 49 and 57 corrected) and a slope is no bump. The state of
Eq. 51 is (A, k, mu_x, mu_y, sigma), the centre relative to the cell's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core import planes
from quadtree_lss.core.config import FeaturesConfig
from quadtree_lss.core.leaves import Leaves
from quadtree_lss.core.statistics import Residuals

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

ITERATIONS = 12
#: Points this many standard deviations above the plane make a cell a candidate.
HIGH = 3.0
#: A first estimate must lower the cost (a chi-square) by this much against flat ground.
SIGNIFICANCE = 25.0
#: Candidates treated in one scan; the rest wait for the next, the strongest go first.
MAX_CANDIDATES = 256


def peak(state: Array) -> Array:
    """Height of bumps over their surroundings, k^2 / (2 pi sigma^2): (..., 5) to (...), m."""
    out: Array = state[..., 1] ** 2 / (2.0 * np.pi * state[..., 4] ** 2)
    return out


def height(state: Array, x: Array, y: Array) -> Array:
    """Eq. 57: height of bumps (..., 5) at x, y (...) relative to the cell's centre, A left out."""
    square = (x - state[..., 2]) ** 2 + (y - state[..., 3]) ** 2
    out: Array = peak(state) * np.exp(-0.5 * square / state[..., 4] ** 2)
    return out


@dataclass(frozen=True)
class Samples:
    """Heights over C cells.

    Attributes:
        cell: (N,) cell of each sample, 0 .. C - 1.
        x, y: (N,) relative to the cell's centre, m.
        z: (N,) height above the cell's plane, m.
        variance: (C,) of z, m^2.
    """

    cell: Index
    x: Array
    y: Array
    z: Array
    variance: Array

    def sum(self, values: Array) -> Array:
        """Sums of (N,) by cell."""
        return np.bincount(self.cell, values, minlength=len(self.variance))


def estimate(
    samples: Samples, mean: Array, information: Array, half: Array, finest: Array
) -> tuple[Array, Array, Array]:
    """Damped, iterated batch EKF update of C states (Levenberg-Marquardt on the MAP cost).

    cost = sum (z - h(X))^2 / variance + (X - mean)^T information (X - mean).

    Args:
        samples: One scan's heights.
        mean: (C, 5) prior, also the start.
        information: (C, 5, 5) inverse prior covariance.
        half: (C,) half the cell's side: the centre stays inside, m.
        finest: (C,) least sigma that the sampling resolves, m.

    Returns:
        States (C, 5), covariances (C, 5, 5), measurement part of the cost (C,).
    """
    state = _bounded(mean, half, finest)
    damping = np.full(len(state), 1e-2)
    cost, data, normal, gradient = _linearise(samples, state, mean, information)
    active = np.ones(len(state), dtype=np.bool_)
    for _ in range(ITERATIONS):
        scale = np.einsum("cii->ci", normal)
        damped = normal + damping[:, None, None] * (scale[:, :, None] * np.eye(5))
        step = np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
        step[~active] = 0.0
        trial = _bounded(state + step, half, finest)
        t_cost, t_data, t_normal, t_gradient = _linearise(samples, trial, mean, information)
        better = active & (t_cost < cost)
        settled = better & (cost - t_cost < 1e-3 * (1.0 + cost) * 0.01)
        state = np.where(better[:, None], trial, state)
        cost, data = np.where(better, t_cost, cost), np.where(better, t_data, data)
        normal = np.where(better[:, None, None], t_normal, normal)
        gradient = np.where(better[:, None], t_gradient, gradient)
        damping = np.clip(np.where(better, 0.2 * damping, 6.0 * damping), 1e-9, 1e9)
        active &= ~settled & (damping < 1e6)
        if not active.any():
            break
    return state, np.linalg.inv(normal), data


def _bounded(state: Array, half: Array, finest: Array) -> Array:
    out = state.copy()
    out[:, 2:4] = np.clip(out[:, 2:4], -half[:, None], half[:, None])
    out[:, 4] = np.clip(np.abs(out[:, 4]), finest, 4.0 * half)
    return out


def _linearise(
    samples: Samples, state: Array, mean: Array, information: Array
) -> tuple[Array, Array, Array, Array]:
    """MAP cost, its measurement part, Gauss-Newton matrix and descent direction at ``state``."""
    cell = samples.cell
    a, k, mx, my, sigma = state.T
    dx, dy = samples.x - mx[cell], samples.y - my[cell]
    inverse_square = 1.0 / sigma**2
    square = (dx * dx + dy * dy) * inverse_square[cell]
    bell = np.exp(-0.5 * square)
    bump = (k * k * inverse_square / (2.0 * np.pi))[cell] * bell
    residual = samples.z - a[cell] - bump
    jacobian = (
        np.ones_like(bump),
        (k * inverse_square / np.pi)[cell] * bell,
        bump * dx * inverse_square[cell],
        bump * dy * inverse_square[cell],
        bump * (square - 2.0) / sigma[cell],
    )
    weight = 1.0 / samples.variance
    normal = np.empty((len(state), 5, 5))
    gradient = np.empty((len(state), 5))
    for i in range(5):
        gradient[:, i] = weight * samples.sum(jacobian[i] * residual)
        for j in range(i, 5):
            normal[:, i, j] = normal[:, j, i] = weight * samples.sum(jacobian[i] * jacobian[j])
    data = weight * samples.sum(residual * residual)
    off = state - mean
    pull = (information @ off[:, :, None])[:, :, 0]
    return (
        data + np.einsum("ci,ci->c", off, pull),
        data,
        normal + information,
        gradient - pull,
    )


def start(samples: Samples, high: Mask, area: Array) -> Array:
    """First states (C, 5) from the data instead of Eq. 52's constants.

    The centre is the highest sample's (as in Eq. 52), A the mean of the others; the samples
    ``high`` above the plane stand for the bump: their share of the cell's area gives sigma, their
    mean height its volume.

    Args:
        high: (N,) samples that stand out; each cell has one or more.
        area: (C,) area of the cells, m^2.
    """
    cells = len(area)
    count = np.maximum(samples.sum(np.ones(len(samples.z))), 1.0)
    order = np.lexsort((samples.z, samples.cell))
    last = np.searchsorted(samples.cell[order], np.arange(cells), side="right") - 1
    top = order[last]
    raised = np.where(high, 1.0, 0.0)
    many = np.maximum(samples.sum(raised), 1.0)
    level = samples.sum((1.0 - raised) * samples.z) / np.maximum(count - many, 1.0)
    footprint = area * many / count
    volume = np.maximum(samples.sum(raised * samples.z) / many - level, 1e-3) * footprint
    out = np.empty((cells, 5))
    out[:, 0] = level
    out[:, 1] = np.sqrt(volume)
    out[:, 2], out[:, 3] = samples.x[top], samples.y[top]
    out[:, 4] = np.sqrt(footprint / (2.0 * np.pi))
    return out


class FeatureEstimator:
    """Keeps the feature columns of the leaves up to date, scan by scan."""

    def __init__(self, config: FeaturesConfig) -> None:
        self.config = config

    def update(self, leaves: Leaves, residuals: Residuals, range_noise: float) -> None:
        """Update the features of the leaves that a scan shows one in, or that had one."""
        rows = residuals.rows
        if not self.config.enabled or not len(rows):
            return
        normal = leaves.normal[rows]
        variance = planes.orthogonal_noise_variance(normal, residuals.moment.ray, range_noise)
        gate = np.maximum(HIGH * np.sqrt(variance), 0.5 * self.config.min_height * normal[:, 2])
        high = np.flatnonzero(residuals.distance > gate[residuals.group])
        raised = np.bincount(residuals.group[high], minlength=len(rows))
        enough = residuals.moment.count >= self.config.min_points
        known = np.isfinite(leaves.feature[rows, 1])
        chosen = np.flatnonzero(enough & ((raised >= 2) | known))
        if not len(chosen):
            return
        if len(chosen) > MAX_CANDIDATES:
            strongest = np.argsort(-raised[chosen], kind="stable")[:MAX_CANDIDATES]
            chosen = np.sort(chosen[strongest])
        self._estimate(leaves, residuals, chosen, variance[chosen], gate[chosen], known[chosen])

    def _estimate(
        self,
        leaves: Leaves,
        residuals: Residuals,
        chosen: Index,
        variance: Array,
        gate: Array,
        known: Mask,
    ) -> None:
        rows = residuals.rows[chosen]
        place = np.full(len(residuals.rows), -1, dtype=np.intp)
        place[chosen] = np.arange(len(chosen))
        cell = place[residuals.group]
        mine = np.flatnonzero(cell >= 0)
        cell = cell[mine]
        up = leaves.normal[rows, 2]
        distance = residuals.distance[mine]
        samples = Samples(
            cell,
            residuals.points[0, mine] + residuals.origin[0] - leaves.x[rows][cell],
            residuals.points[1, mine] + residuals.origin[1] - leaves.y[rows][cell],
            distance / up[cell],
            variance / up**2,
        )
        size = leaves.domain.cell_size(leaves.level[rows])
        count = residuals.moment.count[chosen]
        finest = 0.4 * size / np.sqrt(count)
        fresh = start(samples, distance > gate[cell], size**2)
        mean = np.where(known[:, None], leaves.feature[rows], fresh)
        information = np.broadcast_to(np.eye(5), (len(rows), 5, 5)).copy()
        information[known] = np.linalg.inv(leaves.feature_covariance[rows[known]])
        state, covariance, cost = estimate(samples, mean, information, 0.5 * size, finest)
        flat = samples.sum(samples.z**2) - samples.sum(samples.z) ** 2 / count
        gain = flat / samples.variance - cost
        config = self.config
        keep = (
            (state[:, 1] ** 2 >= config.min_volume)
            & (peak(state) >= config.min_height)
            & (state[:, 4] <= config.max_sigma_fraction * size)
            & (known | (gain >= SIGNIFICANCE))
            & np.isfinite(covariance).all(axis=(1, 2))
        )
        leaves.feature[rows] = np.where(keep[:, None], state, np.nan)
        leaves.feature_covariance[rows] = np.where(keep[:, None, None], covariance, np.nan)
