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
#: Where padding lies, m: no bump reaches there.
FAR = 1e12
AXES = np.arange(5)


@dataclass(frozen=True)
class Samples:
    """Heights over C cells, laid out by cell and padded to the same number P.

    Attributes:
        places: (C, 2, P) x and y relative to the cell's centre, m; far away where padded.
        z: (C, P) height above the cell's plane, m; 0 where padded.
        there: (C, P) 1, or 0 where padded.
        count: (C,) samples.
        weight: (C,) one over the variance of z, m^-2.
    """

    places: Array
    z: Array
    there: Array
    count: Array
    weight: Array

    def take(self, chosen: Index) -> Samples:
        """The chosen cells."""
        return Samples(
            self.places[chosen],
            self.z[chosen],
            self.there[chosen],
            self.count[chosen],
            self.weight[chosen],
        )


def lay_out(cell: Index, variance: Array, x: Array, y: Array, z: Array) -> Samples:
    """Samples from points (N,) of cells (N,), ``variance`` (C,) of each cell's heights.

    A cell with more than ``MAX_SAMPLES`` points keeps every k-th.
    """
    cells = len(variance)
    order = np.argsort(cell, kind="stable")
    ordered = cell[order]
    count = np.bincount(cell, minlength=cells)
    rank = np.arange(len(order)) - (np.cumsum(count) - count)[ordered]
    if count.max(initial=0) > MAX_SAMPLES:
        stride = np.maximum(-(-count // MAX_SAMPLES), 1)
        rank, left = np.divmod(rank, stride[ordered])
        kept = (left == 0).nonzero()[0]
        order, ordered, rank = order[kept], ordered[kept], rank[kept]
        count = -(-count // stride)
    width = max(int(count.max(initial=0)), 1)
    places = np.full((cells, 2, width), FAR)
    places[ordered, 0, rank], places[ordered, 1, rank] = x[order], y[order]
    heights = np.zeros((cells, width))
    heights[ordered, rank] = z[order]
    there = (np.arange(width) < count[:, None]).astype(np.float64)
    return Samples(places, heights, there, count.astype(np.float64), 1.0 / variance)


def flat_cost(samples: Samples) -> Array:
    """Chi-square (C,) of heights about their own mean: the ground without a bump."""
    total = samples.z.sum(axis=1)
    square = np.einsum("cp,cp->c", samples.z, samples.z)
    out: Array = samples.weight * (square - total * total / np.maximum(samples.count, 1.0))
    return out


def promise(samples: Samples, state: Array) -> Array:
    """How much a bump of the state's place and width can lower the flat cost at best, (C,).

    Linear in height, so in closed form: w (sum g z)^2 / sum g^2 with the bell g freed of its
    mean; 0 where the best height is negative.
    """
    away = samples.places - state[:, 2:4, None]
    away *= away
    bell = np.exp((-0.5 / state[:, 4:5] ** 2) * away.sum(axis=1))
    total = bell.sum(axis=1)
    share = total / np.maximum(samples.count, 1.0)
    rise = np.einsum("cp,cp->c", bell, samples.z) - share * samples.z.sum(axis=1)
    square = np.einsum("cp,cp->c", bell, bell)
    spread = np.maximum(square - share * total, 1e-9 * square + 1e-300)
    out: Array = samples.weight * np.maximum(rise, 0.0) ** 2 / spread
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
    bounds = _bounds(half, finest)
    state = _bounded(mean, bounds)
    system, data = _linearise(samples, state, mean, information)
    damping = np.where(known, 0.0, 1e-2)
    index, final = np.arange(len(state)), (state.copy(), system.copy(), data.copy())
    for _ in range(ITERATIONS):
        damped = system[:, :5, :5].copy()
        damped[:, AXES, AXES] *= 1.0 + damping[:, None]
        step = np.linalg.solve(damped, system[:, :5, 5:])[:, :, 0]
        trial = _bounded(state + step, bounds)
        found, found_data = _linearise(samples, trial, mean, information)
        gain = system[:, 5, 5] - found[:, 5, 5]
        better = gain > 0.0
        state = np.where(better[:, None], trial, state)
        system = np.where(better[:, None, None], found, system)
        data = np.where(better, found_data, data)
        for kept, value in zip(final, (state, system, data), strict=True):
            kept[index] = value
        damping *= np.where(better, 0.2, 6.0)
        settled = known | (np.abs(gain) < SETTLED * (1.0 + found[:, 5, 5])) | (damping > 1e6)
        left = (~settled).nonzero()[0]
        if not len(left):
            break
        if len(left) < len(index):
            index, state, system, data = index[left], state[left], system[left], data[left]
            mean, information, known = mean[left], information[left], known[left]
            damping, bounds, samples = damping[left], bounds[:, left], samples.take(left)
    state, system, data = final
    covariance: Array = np.linalg.inv(system[:, :5, :5]).astype(np.float64)
    return state, covariance, data


def _bounds(half: Array, finest: Array) -> Array:
    """Least and greatest states, (2, C, 5)."""
    out = np.empty((2, len(half), 5))
    out[0, :, :2], out[1, :, :2] = -np.inf, np.inf
    out[0, :, 2:4], out[1, :, 2:4] = -half[:, None], half[:, None]
    out[0, :, 4], out[1, :, 4] = finest, 4.0 * half
    return out


def _bounded(state: Array, bounds: Array) -> Array:
    out: Array = np.maximum(state, bounds[0])
    out[:, 4] = np.maximum(np.abs(state[:, 4]), bounds[0, :, 4])
    np.minimum(out, bounds[1], out=out)
    return out


def _linearise(
    samples: Samples, state: Array, mean: Array, information: Array
) -> tuple[Array, Array]:
    """The MAP cost about ``state``, (C, 6, 6): Gauss-Newton matrix [:5, :5], descent direction
    [:5, 5] and cost [5, 5]; and the measurements' part of the cost (C,)."""
    sigma = state[:, 4]
    inverse_square = 1.0 / (sigma * sigma)
    away = samples.places - state[:, 2:4, None]
    square = (away * away).sum(axis=1)
    square *= inverse_square[:, None]
    bell = np.exp(-0.5 * square)
    twice = (state[:, 1] * inverse_square / np.pi)[:, None]
    rows = np.empty((len(state), 6, samples.z.shape[1]))
    rows[:, 0] = samples.there
    np.multiply(twice, bell, out=rows[:, 1])
    bump = rows[:, 1] * (0.5 * state[:, 1:2])
    np.multiply(away, (bump * inverse_square[:, None])[:, None], out=rows[:, 2:4])
    square -= 2.0
    square *= bump
    np.divide(square, sigma[:, None], out=rows[:, 4])
    np.subtract(samples.z, bump, out=rows[:, 5])
    rows[:, 5] -= state[:, :1] * samples.there
    system = rows @ rows.transpose(0, 2, 1)
    system *= samples.weight[:, None, None]
    data = system[:, 5, 5].copy()
    off = state - mean
    pull = (information @ off[:, :, None])[:, :, 0]
    system[:, :5, :5] += information
    system[:, :5, 5] -= pull
    system[:, 5, 5] += (off * pull).sum(axis=1)
    return system, data


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


def first_states(raised: Raised, points: Array, area: Array) -> Array:
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
