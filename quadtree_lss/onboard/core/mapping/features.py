# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False
"""Subscale features: one bell in a leaf, smaller than the leaf (paper V.C).

Heights are above the cell's plane, so that a slope is not a feature. The state is Eq. 51's
(A, k, mu_x, mu_y, sigma), the centre relative to the cell's; the height over the plane is
A + p exp(-r^2 / 2 sigma^2) with p = k^2 / (2 pi sigma^2), so that k^2 is the bump's volume
(Eq. 49, Eq. 50, Eq. 51 and Eq. 57 with their errata).
"""

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.libc.math import NAN, fabs, isfinite, sqrt

from quadtree_lss.onboard.core.geometry.sphere import Vector
from quadtree_lss.onboard.core.mapping.measure import Rules
from quadtree_lss.onboard.core.tree import cell_map
from quadtree_lss.onboard.core.tree.leaves import Record

PI = cython.declare(cython.double, 3.141592653589793)
#: Points this many standard deviations above the plane make a cell a candidate.
RAISED_SIGMAS = cython.declare(cython.double, 3.0)
#: Share of points that noise raises so high, P(N(0, 1) > 3).
CHANCE = cython.declare(cython.double, 0.00135)
#: Half side of the square around a feature whose points are used, in sigma.
WINDOW = cython.declare(cython.double, 5.0)
#: A first estimate must lower the cost (a chi-square) by this much against flat ground.
SIGNIFICANCE = cython.declare(cython.double, 25.0)
#: Least points of one scan for a feature's five parameters.
MIN_SAMPLES = cython.declare(cython.double, 12.0)
#: Greatest number of points of one scan in an estimate, and in the first state.
MAX_SAMPLES = cython.declare(cython.Py_ssize_t, 512)
MAX_RAISED = cython.declare(cython.Py_ssize_t, 24)
SHAPE = cython.declare(cython.double, cell_map.SHAPE)
#: Greatest number of updates of a first estimate.
ITERATIONS = cython.declare(cython.int, 5)
#: Relative change of the cost at which an estimate has converged.
CONVERGED = cython.declare(cython.double, 5e-2)


class Heights:
    """Heights of a scan of at most ``most`` points over the plane of one cell, near its feature:
    ``count`` places ``x``, ``y`` about the cell's centre and heights ``z``, m, and the ``weight``
    of each, its inverse variance, m^-2."""

    def __init__(self, most: int) -> None:
        self.near = np.empty(most + 1, dtype=np.intp)
        self.x, self.y, self.z, self.bell = np.empty((4, MAX_SAMPLES))
        self.row = np.ones((MAX_SAMPLES, 6))
        self.count = 0
        self.weight = 0.0


def bell(square: float) -> cython.double:
    """Return exp(-square / 2), to 1e-9 up to 20, almost 0 from 80 on, as
    1 / (1 + r + r^2 / 2 + ...)^256, r = square / 512: without branches, so that loops vectorise."""
    r = square * (1.0 / 512.0)
    e = 1.0 + r * (1.0 + r * (0.5 + r * (1.0 / 6.0 + r * (1.0 / 24.0 + r * (1.0 / 120.0)))))
    for _ in range(8):
        e *= e
    return 1.0 / e


def bells(heights: Heights, state: Vector) -> None:
    """Write `bell` at each height to ``heights.bell``, for the centre and sigma of a state (5)."""
    i: cython.Py_ssize_t
    x, y = state[2], state[3]
    inverse = 1.0 / (state[4] * state[4])
    for i in range(heights.count):
        dx = heights.x[i] - x
        dy = heights.y[i] - y
        heights.bell[i] = bell((dx * dx + dy * dy) * inverse)


def feature_height(state: Vector) -> cython.double:
    """Return the height of the rock that a fitted bell (5) represents, m."""
    return state[1] * state[1] / (2.0 * PI * state[4] * state[4] * SHAPE)


def max_gain(heights: Heights, state: Vector) -> cython.double:
    """Return the greatest reduction of the flat cost by a feature of the state's place and width:
    w (sum g z)^2 / sum g^2 with the bell g minus its mean, as the model is linear in the height; 0
    if the best height is negative."""
    i: cython.Py_ssize_t
    total = square = product = high = 0.0
    bells(heights, state)
    for i in range(heights.count):
        there = heights.bell[i]
        total += there
        square += there * there
        product += there * heights.z[i]
        high += heights.z[i]
    share = total / max(heights.count, 1.0)
    rise = max(product - share * high, 0.0)
    return heights.weight * rise * rise / max(square - share * total, 1e-9 * square + 1e-300)


def _linearise(
    heights: Heights, state: Vector, mean: Vector, information: Vector, system: Vector
) -> cython.double:
    """Linearise the MAP cost about ``state``: Gauss-Newton matrix and descent direction, (5, 6).

    cost = sum (z - h(X))^2 / variance + (X - mean)^T information (X - mean). Returns it; system[30]
    is the part of the measurements, system[31] the total.
    """
    # Whole rows of sums vectorise. Separate loops: reading two fresh stores as one vector stalls.
    total = cython.declare(cython.double[30])
    cython.declare(i=cython.Py_ssize_t, j=cython.int, k=cython.int)
    for j in range(30):
        total[j] = 0.0
    level, root, x, y, sigma = state[0], state[1], state[2], state[3], state[4]
    inverse = 1.0 / (sigma * sigma)
    twice = root * inverse / PI
    bells(heights, state)
    for i in range(heights.count):
        dx = heights.x[i] - x
        dy = heights.y[i] - y
        square = (dx * dx + dy * dy) * inverse
        high = twice * heights.bell[i]
        bump = 0.5 * root * high
        heights.row[i, 1] = high
        heights.row[i, 2] = dx * bump * inverse
        heights.row[i, 3] = dy * bump * inverse
        heights.row[i, 4] = (square - 2.0) * bump / sigma
        heights.row[i, 5] = heights.z[i] - bump - level
    cost = 0.0
    for i in range(heights.count):
        for j in range(5):
            for k in range(j & ~1, 6):
                total[6 * j + k] += heights.row[i, j] * heights.row[i, k]
        cost += heights.row[i, 5] * heights.row[i, 5]
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
    """Compute a step (5) of the damped normal equations by Cholesky; False if they are not
    definite."""
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
    """Update a state (5) and its inverse covariance (25) by a damped, iterated batch EKF
    (Levenberg-Marquardt on the MAP cost); return the measurements' part of the cost.

    A state from earlier scans (``known``) takes one full step, if that lowers the cost. The centre
    stays inside the cell (``half`` its side, m), sigma is at least ``finest``, m.
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
        if known or fabs(gain) < CONVERGED * (1.0 + found[31]) or damping > 1e6:
            break
    for i in range(5):
        for j in range(5):
            information[5 * i + j] = system[6 * i + j]
    return system[30]


def insert_high(
    high: Vector, held: cython.Py_ssize_t, x: float, y: float, z: float
) -> cython.Py_ssize_t:
    """Insert a raised sample into the `MAX_RAISED` highest (x, y, z each); return their number."""
    i: cython.Py_ssize_t = held
    if held == MAX_RAISED:
        if z <= high[3 * held - 1]:
            return held
        i = held - 1
    while i > 0 and high[3 * i - 1] < z:
        high[3 * i] = high[3 * i - 3]
        high[3 * i + 1] = high[3 * i - 2]
        high[3 * i + 2] = high[3 * i - 1]
        i -= 1
    high[3 * i] = x
    high[3 * i + 1] = y
    high[3 * i + 2] = z
    return held if held == MAX_RAISED else held + 1


def first_state(
    raised: cython.Py_ssize_t, high: Vector, count: float, area: float, least: float, out: Vector
) -> None:
    """Compute the first state (5) from the data instead of Eq. 52's constants.

    The centre is the raised sample with the greatest sum of heights of raised samples near it;
    these give sigma by their share of the cell's ``area``, m^2, and the volume by their mean
    height. ``high``: (3 raised) x, y, z; ``count``: heights of the cell, of sum zero; ``least``:
    height of the lowest feature, m.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    best: cython.Py_ssize_t = 0
    width = max(1.5 * sqrt(area / count), least)
    most = -1.0
    for i in range(raised):
        collected = 0.0
        for j in range(raised):
            dx = high[3 * i] - high[3 * j]
            dy = high[3 * i + 1] - high[3 * j + 1]
            collected += high[3 * j + 2] * bell((dx * dx + dy * dy) / (width * width))
        if collected > most:
            most = collected
            best = i
    many = total = 0.0
    for j in range(raised):
        dx = high[3 * best] - high[3 * j]
        dy = high[3 * best + 1] - high[3 * j + 1]
        if dx * dx + dy * dy < 9.0 * width * width:
            many += 1.0
            total += high[3 * j + 2]
    level = -total / max(count - many, 1.0)
    footprint = area * many / count
    out[0] = level
    out[1] = sqrt(max(total / many - level, 0.01 * least) * footprint)
    out[2] = high[3 * best]
    out[3] = high[3 * best + 1]
    out[4] = sqrt(footprint / (2.0 * PI))


def update_feature(
    rules: Rules,
    leaf: Record,
    run: Record,
    points: Vector,
    residual: Vector,
    origin: Vector,
    side: float,
    heights: Heights,
) -> None:
    """Update the feature of a leaf, or start one if clearly more points are raised than noise
    explains on flat ground; it ends if later scans do not show it.

    ``points`` (3 N) are about the lidar, ``origin`` (3) is that in the map, ``residual`` (N) is
    n.(r - mean), ``side`` that of the cell, m.
    """
    high = cython.declare(cython.double[72])
    state = cython.declare(cython.double[5])
    information = cython.declare(cython.double[25])
    cython.declare(i=cython.Py_ssize_t, k=cython.Py_ssize_t, stride=cython.Py_ssize_t)
    inside: cython.Py_ssize_t = 0
    held: cython.Py_ssize_t = 0
    raised: cython.Py_ssize_t = 0
    count = run.points
    if count < MIN_SAMPLES:
        return
    number: cython.Py_ssize_t = cython.cast(cython.Py_ssize_t, count)
    x, y, up = leaf.x - origin[0], leaf.y - origin[1], leaf.normal[2]
    known: cython.bint = isfinite(leaf.feature[1])
    gate = max(RAISED_SIGMAS * sqrt(run.variance), 0.5 * rules.feature_height * up)
    if not known and run.max_residual > gate:
        for i in range(number):
            # A float rather than a bool, so that the loop vectorises.
            one = 1.0 if residual[i] > gate else 0.0
            raised += cython.cast(cython.int, one)
    chance = CHANCE * count
    if not known and raised < max(2.0, chance + 2.0 * sqrt(chance)):
        return
    heights.weight = up * up / run.variance
    if known:
        for k in range(5):
            state[k] = leaf.feature[k]
        for k in range(25):
            information[k] = leaf.feature_information[k]
    else:
        for i in range(number):
            if residual[i] > gate:
                east, north = points[3 * i] - x, points[3 * i + 1] - y
                held = insert_high(high, held, east, north, residual[i] / up)
        first_state(held, high, count, side * side, rules.feature_height, state)
        # Eq. 52's unit covariance, in a unit that is 1 m for the default vehicle; k^2 is a volume.
        unit = 10.0 * rules.feature_height
        for k in range(25):
            information[k] = 1.0 / (unit * unit) if k % 6 == 0 else 0.0
        information[6] /= unit
    reach = min(max(WINDOW * state[4], 5.0 * rules.feature_height), side)
    middle_x, middle_y = x + state[2], y + state[3]
    for i in range(number):
        # Branch-free: mispredictions are costly here.
        heights.near[inside] = i
        off = max(fabs(points[3 * i] - middle_x), fabs(points[3 * i + 1] - middle_y))
        inside += off <= reach
    stride = max((inside + MAX_SAMPLES - 1) // MAX_SAMPLES, 1)
    heights.count = (inside + stride - 1) // stride
    for k in range(heights.count):
        i = heights.near[k * stride]
        heights.x[k] = points[3 * i] - x
        heights.y[k] = points[3 * i + 1] - y
        heights.z[k] = residual[i] / up
    if not known and max_gain(heights, state) < 0.5 * SIGNIFICANCE:
        return
    total = square = 0.0
    for i in range(heights.count):
        total += heights.z[i]
        square += heights.z[i] * heights.z[i]
    flat = heights.weight * (square - total * total / max(heights.count, 1.0))
    cost = estimate(heights, state, information, known, 0.5 * side, 0.4 * side / sqrt(count))
    keep: cython.bint = (
        state[1] * state[1] >= rules.feature_volume
        and feature_height(state) >= rules.feature_height
        and state[4] <= rules.feature_width * side
        and (known or flat - cost >= SIGNIFICANCE)
    )
    for k in range(5):
        leaf.feature[k] = state[k] if keep else NAN
    for k in range(25):
        leaf.feature_information[k] = information[k]
