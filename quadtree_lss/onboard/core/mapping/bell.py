# SPDX-License-Identifier: Apache-2.0
"""A bell fitted to heights: the iterated EKF update of Eq. 51's state (A, k, mu_x, mu_y, sigma)."""

from __future__ import annotations

import cython
import numpy as np

from quadtree_lss.onboard.core.geometry.sphere import Vector

if not cython.compiled:
    from math import exp, fabs, sqrt

PI = cython.declare(cython.double, 3.141592653589793)
#: Peak of the bell that fits a hemisphere (Eq. 53) best over the hemisphere's height.
SHAPE = cython.declare(cython.double, 1.25)
#: Updates of a first estimate at most.
ITERATIONS = cython.declare(cython.int, 5)
#: Relative change of the cost at which an estimate has converged.
SETTLED = cython.declare(cython.double, 5e-2)


class Heights:
    """Heights of one scan over one cell, those that may tell of a feature; room for a scan's."""

    def __init__(self, most: int) -> None:
        self.x = np.empty(most)
        self.y = np.empty(most)
        self.z = np.empty(most)
        self.count = 0
        self.weight = 0.0

    def clear(self, weight: float) -> None:
        """Forget them; ``weight`` is one over the variance of the next ones, m^-2."""
        self.count = 0
        self.weight = weight

    @cython.boundscheck(False)
    def add(self, x: float, y: float, z: float) -> None:
        """A height above the plane, at a place relative to the cell's centre, m."""
        self.x[self.count] = x
        self.y[self.count] = y
        self.z[self.count] = z
        self.count += 1


def feature_height(state: Vector) -> cython.double:
    """Height of the rock that a fitted bell (5) stands for, m.

    A bell fitted to a hemisphere by least squares peaks a quarter above it.
    """
    return state[1] * state[1] / (2.0 * PI * state[4] * state[4] * SHAPE)


@cython.boundscheck(False)
def promise(heights: Heights, state: Vector) -> cython.double:
    """How much a feature of the state's place and width can lower the flat cost at best.

    Linear in height, so in closed form: w (sum g z)^2 / sum g^2 with the bell g freed of its mean;
    0 where the best height is negative.
    """
    i: cython.Py_ssize_t
    total = square = product = high = 0.0
    for i in range(heights.count):
        dx = heights.x[i] - state[2]
        dy = heights.y[i] - state[3]
        bell = exp(-0.5 * (dx * dx + dy * dy) / (state[4] * state[4]))
        total += bell
        square += bell * bell
        product += bell * heights.z[i]
        high += heights.z[i]
    share = total / max(heights.count, 1.0)
    rise = max(product - share * high, 0.0)
    return heights.weight * rise * rise / max(square - share * total, 1e-9 * square + 1e-300)


@cython.boundscheck(False)
def _linearise(
    heights: Heights, state: Vector, mean: Vector, information: Vector, system: Vector
) -> cython.double:
    """The MAP cost about ``state``: Gauss-Newton matrix and descent direction, (5, 6) in system.

    cost = sum (z - h(X))^2 / variance + (X - mean)^T information (X - mean), returned; the
    measurements' part of it is system[30], all of it system[31].
    """
    # Whole rows of sums, of which the lower half is not used, are computed two at a time.
    row = cython.declare(cython.double[6])
    total = cython.declare(cython.double[30])
    cython.declare(i=cython.Py_ssize_t, j=cython.int, k=cython.int)
    for j in range(30):
        total[j] = 0.0
    level, root, x, y, sigma = state[0], state[1], state[2], state[3], state[4]
    inverse = 1.0 / (sigma * sigma)
    twice = root * inverse / PI
    row[0] = 1.0
    cost = 0.0
    for i in range(heights.count):
        dx = heights.x[i] - x
        dy = heights.y[i] - y
        square = (dx * dx + dy * dy) * inverse
        row[1] = twice * exp(-0.5 * square) if square < 80.0 else 0.0
        bump = 0.5 * root * row[1]
        row[2] = dx * bump * inverse
        row[3] = dy * bump * inverse
        row[4] = (square - 2.0) * bump / sigma
        row[5] = heights.z[i] - bump - level
        for j in range(5):
            for k in range(6):
                total[6 * j + k] += row[j] * row[k]
        cost += row[5] * row[5]
    for j in range(30):
        system[j] = total[j]
    cost *= heights.weight
    system[30] = cost
    for j in range(5):
        pull = 0.0
        for k in range(5):
            pull += information[5 * j + k] * (state[k] - mean[k])
        cost += (state[j] - mean[j]) * pull
        system[6 * j + 5] = heights.weight * system[6 * j + 5] - pull
        for k in range(j, 5):
            system[6 * j + k] = heights.weight * system[6 * j + k] + information[5 * j + k]
            if k > j:
                system[6 * k + j] = system[6 * j + k]
    system[31] = cost
    return cost


def _solve(system: Vector, damping: float, step: Vector) -> cython.bint:
    """Step (5) of the damped normal equations by Cholesky; False if they are not definite."""
    lower = cython.declare(cython.double[25])
    cython.declare(i=cython.int, j=cython.int, k=cython.int)
    for i in range(5):
        for j in range(i + 1):
            total = system[6 * i + j]
            if i == j:
                total *= 1.0 + damping
            for k in range(j):
                total -= lower[5 * i + k] * lower[5 * j + k]
            if i == j:
                if not total > 0.0:
                    return False
                lower[6 * i] = sqrt(total)
            else:
                lower[5 * i + j] = total / lower[6 * j]
    for i in range(5):
        total = system[6 * i + 5]
        for k in range(i):
            total -= lower[5 * i + k] * step[k]
        step[i] = total / lower[6 * i]
    for i in range(4, -1, -1):
        total = step[i]
        for k in range(i + 1, 5):
            total -= lower[5 * k + i] * step[k]
        step[i] = total / lower[6 * i]
    return True


def estimate(
    heights: Heights,
    state: Vector,
    information: Vector,
    known: cython.bint,
    half: float,
    finest: float,
) -> cython.double:
    """Damped, iterated batch EKF update of a state (Levenberg-Marquardt on the MAP cost).

    A state that earlier scans estimated takes one full step, if that lowers its cost: scan by scan
    it goes on from there.

    Args:
        heights: One scan's.
        state: (5) prior and start; replaced by the estimate.
        information: (25) inverse prior covariance; replaced by the posterior one.
        known: Whether earlier scans estimated the state.
        half: Half the cell's side: the centre stays inside, m.
        finest: Least sigma that the sampling resolves, m.

    Returns:
        The measurements' part of the cost.
    """
    mean = cython.declare(cython.double[5])
    trial = cython.declare(cython.double[5])
    step = cython.declare(cython.double[5])
    system = cython.declare(cython.double[32])
    found = cython.declare(cython.double[32])
    cython.declare(i=cython.int, j=cython.int)
    for i in range(5):
        mean[i] = state[i]
    state[4] = min(max(fabs(state[4]), finest), 4.0 * half)
    for i in range(2, 4):
        state[i] = min(max(state[i], -half), half)
    _linearise(heights, state, mean, information, system)
    damping = 0.0 if known else 1e-2
    for _ in range(ITERATIONS):
        if not _solve(system, damping, step):
            break
        for i in range(5):
            trial[i] = state[i] + step[i]
        trial[4] = min(max(fabs(trial[4]), finest), 4.0 * half)
        for i in range(2, 4):
            trial[i] = min(max(trial[i], -half), half)
        gain = system[31] - _linearise(heights, trial, mean, information, found)
        if gain > 0.0:
            damping *= 0.2
            for i in range(5):
                state[i] = trial[i]
            for i in range(32):
                system[i] = found[i]
        else:
            damping *= 6.0
        if known or fabs(gain) < SETTLED * (1.0 + found[31]) or damping > 1e6:
            break
    for i in range(5):
        for j in range(5):
            information[5 * i + j] = system[6 * i + j]
    return system[30]
