# SPDX-License-Identifier: Apache-2.0
"""Fitting a bump (Eq. 49, Eq. 51) to the heights over a cell: its start and the filter's update.

All cells are treated at once: leading dimension C.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: Updates of a first estimate at most.
ITERATIONS = 5
#: Points of one scan that a cell's feature is estimated from, at most.
MAX_SAMPLES = 512
#: Relative change of the cost at which an estimate has converged.
SETTLED = 5e-2


@dataclass(frozen=True)
class Samples:
    """Heights over C cells, laid out by cell and padded to the same number P.

    Attributes:
        x, y: (C, P) relative to the cell's centre, m.
        z: (C, P) height above the cell's plane, m.
        weight: (C, P) one over the variance of z, m^-2; 0 where padded.
    """

    x: Array
    y: Array
    z: Array
    weight: Array

    def take(self, chosen: Index) -> Samples:
        """The chosen cells."""
        return Samples(self.x[chosen], self.y[chosen], self.z[chosen], self.weight[chosen])


def lay_out(cell: Index, variance: Array, x: Array, y: Array, z: Array) -> Samples:
    """Samples from points (N,) of cells (N,), ``variance`` (C,) of each cell's heights.

    A cell with more than ``MAX_SAMPLES`` points keeps every k-th.
    """
    cells = len(variance)
    order = np.argsort(cell, kind="stable")
    ordered = cell[order]
    count = np.bincount(cell, minlength=cells)
    rank = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    stride = -(-count // MAX_SAMPLES)[ordered]
    kept = rank % stride == 0
    order, at = order[kept], (ordered[kept], (rank // stride)[kept])
    width = int(at[1].max()) + 1 if len(order) else 1
    out = np.zeros((4, cells, width))
    for axis, values in enumerate((x[order], y[order], z[order], 1.0 / variance[at[0]])):
        out[axis][at] = values
    return Samples(out[0], out[1], out[2], out[3])


def flat_cost(samples: Samples) -> Array:
    """Chi-square (C,) of heights about their own mean: the ground without a bump."""
    total = np.maximum(samples.weight.sum(axis=1), 1e-300)
    mean = (samples.weight * samples.z).sum(axis=1) / total
    out: Array = (samples.weight * (samples.z - mean[:, None]) ** 2).sum(axis=1)
    return out


def promise(samples: Samples, state: Array) -> Array:
    """How much a bump of the state's place and width can lower the flat cost at best, (C,).

    Linear in height, so in closed form: (sum w g z)^2 / sum w g^2 with the bell g freed of its
    mean; 0 where the best height is negative.
    """
    square = (samples.x - state[:, 2:3]) ** 2 + (samples.y - state[:, 3:4]) ** 2
    bell = np.exp(-0.5 * square / state[:, 4:5] ** 2)
    total = np.maximum(samples.weight.sum(axis=1, keepdims=True), 1e-300)
    bell -= (samples.weight * bell).sum(axis=1, keepdims=True) / total
    bell *= samples.weight
    rise = np.maximum((bell * samples.z).sum(axis=1), 0.0)
    weight = (bell * bell / np.maximum(samples.weight, 1e-300)).sum(axis=1)
    out: Array = rise**2 / np.maximum(weight, 1e-300)
    return out


def estimate(
    samples: Samples, mean: Array, information: Array, known: Mask, half: Array, finest: Array
) -> tuple[Array, Array, Array]:
    """Damped, iterated batch EKF update of C states (Levenberg-Marquardt on the MAP cost).

    cost = sum (z - h(X))^2 / variance + (X - mean)^T information (X - mean).

    A state that earlier scans estimated takes one full step, if that lowers its cost: scan by scan
    it goes on from there.

    Args:
        samples: One scan's heights.
        mean: (C, 5) prior, also the start.
        information: (C, 5, 5) inverse prior covariance.
        known: (C,) True where earlier scans estimated the state.
        half: (C,) half the cell's side: the centre stays inside, m.
        finest: (C,) least sigma that the sampling resolves, m.

    Returns:
        States (C, 5), covariances (C, 5, 5), measurement part of the cost (C,).
    """
    state = _bounded(mean, half, finest)
    damping = np.where(known, 0.0, 1e-2)
    cost, data, normal, gradient = _linearise(samples, state, mean, information)
    active = np.arange(len(state))
    for _ in range(ITERATIONS):
        scale = np.einsum("cii->ci", normal[active])
        damped = normal[active] + (damping[active, None] * scale)[:, :, None] * np.eye(5)
        step = np.linalg.solve(damped, gradient[active, :, None])[:, :, 0]
        trial = _bounded(state[active] + step, half[active], finest[active])
        t_cost, t_data, t_normal, t_gradient = _linearise(
            samples.take(active), trial, mean[active], information[active]
        )
        gain = cost[active] - t_cost
        better = gain > 0.0
        won = active[better]
        state[won], cost[won], data[won] = trial[better], t_cost[better], t_data[better]
        normal[won], gradient[won] = t_normal[better], t_gradient[better]
        damping[active] *= np.where(better, 0.2, 6.0)
        settled = (np.abs(gain) < SETTLED * (1.0 + t_cost)) | (damping[active] > 1e6)
        active = active[~(settled | known[active])]
        if not len(active):
            break
    covariance: Array = np.linalg.inv(normal).astype(np.float64)
    return state, covariance, data


def _bounded(state: Array, half: Array, finest: Array) -> Array:
    out = state.copy()
    out[:, 2:4] = np.minimum(np.maximum(out[:, 2:4], -half[:, None]), half[:, None])
    out[:, 4] = np.minimum(np.maximum(np.abs(out[:, 4]), finest), 4.0 * half)
    return out


def _linearise(
    samples: Samples, state: Array, mean: Array, information: Array
) -> tuple[Array, Array, Array, Array]:
    """MAP cost, its measurement part, Gauss-Newton matrix and descent direction at ``state``."""
    a, k, mx, my, sigma = state.T[:, :, None]
    inverse_square = 1.0 / sigma**2
    dx, dy = samples.x - mx, samples.y - my
    square = (dx * dx + dy * dy) * inverse_square
    bell = np.exp(-0.5 * square)
    bump = (k * k * inverse_square / (2.0 * np.pi)) * bell
    rows = np.empty((len(state), 6, samples.x.shape[1]))
    rows[:, 0] = 1.0
    rows[:, 1] = (k * inverse_square / np.pi) * bell
    rows[:, 2] = bump * dx * inverse_square
    rows[:, 3] = bump * dy * inverse_square
    rows[:, 4] = bump * (square - 2.0) / sigma
    rows[:, 5] = samples.z - a - bump
    products = (rows * samples.weight[:, None, :]) @ rows.transpose(0, 2, 1)
    off = state - mean
    pull = (information @ off[:, :, None])[:, :, 0]
    return (
        products[:, 5, 5] + np.einsum("ci,ci->c", off, pull),
        products[:, 5, 5].copy(),
        products[:, :5, :5] + information,
        products[:, :5, 5] - pull,
    )


@dataclass(frozen=True)
class Raised:
    """Samples that stand out of C cells, ``K`` of them at most in each, padded with height 0.

    Attributes:
        x, y: (C, K) relative to the cell's centre, m.
        z: (C, K) height above the cell's plane, m; 0 where padded.
        count: (C,) how many there are.
    """

    x: Array
    y: Array
    z: Array
    count: Array


MAX_RAISED = 24


def gather_raised(cell: Index, cells: int, x: Array, y: Array, z: Array) -> Raised:
    """Lay out samples (N,) by cell, the highest ``MAX_RAISED`` of each."""
    order = np.lexsort((-z, cell))
    ordered = cell[order]
    first = np.searchsorted(ordered, np.arange(cells))
    rank = np.arange(len(order)) - first[ordered]
    fits = rank < MAX_RAISED
    at = (ordered[fits], rank[fits])
    out = np.zeros((3, cells, MAX_RAISED))
    for axis, values in enumerate((x, y, z)):
        out[axis][at] = values[order[fits]]
    count = np.bincount(cell, minlength=cells).astype(np.float64)
    return Raised(out[0], out[1], out[2], count)


def start(raised: Raised, points: Array, area: Array) -> Array:
    """First states (C, 5) from the data instead of Eq. 52's constants.

    Every raised sample collects the heights of the raised samples near it; the richest one is the
    centre, which a single outlier is not. Those near it stand for the bump: their share of the
    cell's area gives sigma, their mean height over the rest its volume.

    Args:
        raised: Samples that stand out, at least one in each cell.
        points: (C,) samples in each cell; their heights sum to zero.
        area: (C,) area of the cells, m^2.
    """
    spacing = np.sqrt(area / points)
    width = np.maximum(1.5 * spacing, 0.1)
    square = (raised.x[:, :, None] - raised.x[:, None, :]) ** 2
    square += (raised.y[:, :, None] - raised.y[:, None, :]) ** 2
    near = np.exp(-0.5 * square / (width**2)[:, None, None])
    collected = np.where(raised.z > 0.0, (near @ raised.z[:, :, None])[:, :, 0], -1.0)
    best = np.argmax(collected, axis=1)
    row = np.arange(len(area))
    inside = (square[row, best] < (3.0 * width[:, None]) ** 2) & (raised.z > 0.0)
    many = np.maximum(np.count_nonzero(inside, axis=1), 1)
    total = np.sum(np.where(inside, raised.z, 0.0), axis=1)
    level = -total / np.maximum(points - many, 1.0)
    footprint = area * many / points
    volume = np.maximum(total / many - level, 1e-3) * footprint
    return np.stack(
        [
            level,
            np.sqrt(volume),
            raised.x[row, best],
            raised.y[row, best],
            np.sqrt(footprint / (2.0 * np.pi)),
        ],
        axis=1,
    )
