# SPDX-License-Identifier: Apache-2.0
"""Subscale features: one bell in a leaf, smaller than the leaf (paper V.C).

Heights are above the cell's plane, so that a slope is no feature. The state is Eq. 51's
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
HIGH = cython.declare(cython.double, 3.0)
#: Fraction of points that noise alone raises so high, P(N(0, 1) > 3).
CHANCE = cython.declare(cython.double, 0.00135)
#: Half side of the square around a feature whose points are used, in sigma.
WINDOW = cython.declare(cython.double, 5.0)
#: A first estimate must lower the cost (a chi-square) by this much against flat ground.
SIGNIFICANCE = cython.declare(cython.double, 25.0)
#: Points of one scan that a feature is estimated from, at most, and that start its estimate.
MAX_SAMPLES = cython.declare(cython.Py_ssize_t, 512)
MAX_RAISED = cython.declare(cython.Py_ssize_t, 24)
SHAPE = cython.declare(cython.double, cell_map.SHAPE)
#: Updates of a first estimate at most.
ITERATIONS = cython.declare(cython.int, 5)
#: Relative change of the cost at which an estimate has converged.
SETTLED = cython.declare(cython.double, 5e-2)


class Heights:
    """Heights of one scan over one cell, those that may tell of a feature; ``near``: which of the
    scan's ``most`` points lie near it."""

    def __init__(self, most: int) -> None:
        self.near = np.empty(most + 1, dtype=np.intp)
        self.x, self.y, self.z, self.bell = np.empty((4, MAX_SAMPLES))
        self.row = np.ones((MAX_SAMPLES, 6))
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


def bell(square: float) -> cython.double:
    """exp(-square / 2) of a squared distance over sigma^2, to a billionth up to 20 and next to
    nothing from 80 on.

    It is 1 / (1 + r + r^2 / 2 + ...)^256, r = square / 512: numbers only and no choice, so that
    many are computed at once.
    """
    r = square * (1.0 / 512.0)
    e = 1.0 + r * (1.0 + r * (0.5 + r * (1.0 / 6.0 + r * (1.0 / 24.0 + r * (1.0 / 120.0)))))
    for _ in range(8):
        e *= e
    return 1.0 / e


@cython.boundscheck(False)
def bells(heights: Heights, state: Vector) -> None:
    """What `bell` is at the place of each height, for the centre and sigma of a state (5), to
    ``heights.bell``."""
    i: cython.Py_ssize_t
    x, y = state[2], state[3]
    inverse = 1.0 / (state[4] * state[4])
    for i in range(heights.count):
        dx = heights.x[i] - x
        dy = heights.y[i] - y
        heights.bell[i] = bell((dx * dx + dy * dy) * inverse)


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


@cython.boundscheck(False)
def _linearise(
    heights: Heights, state: Vector, mean: Vector, information: Vector, system: Vector
) -> cython.double:
    """The MAP cost about ``state``: Gauss-Newton matrix and descent direction, (5, 6) in system.

    cost = sum (z - h(X))^2 / variance + (X - mean)^T information (X - mean), returned; the
    measurements' part of it is system[30], all of it system[31].
    """
    # Whole rows of sums, of which the lower half is not used, are computed two at a time, and apart
    # from what they are of: two numbers that were just stored one by one a processor is slow to
    # take as a pair.
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
    """Damped, iterated batch EKF update of a state (Levenberg-Marquardt on the MAP cost); returns
    the measurements' part of the cost.

    A state that earlier scans estimated (``known``) takes one full step, if that lowers its cost:
    scan by scan it goes on from there. ``state`` (5) and its inverse covariance ``information``
    (25) are prior and start, and replaced. The centre stays inside ``half`` the cell's side, sigma
    is at least ``finest``, m.
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


def insert_high(
    high: Vector, held: cython.Py_ssize_t, x: float, y: float, z: float
) -> cython.Py_ssize_t:
    """Keep a raised sample among the ``MAX_RAISED`` highest (x, y, z each); how many are held."""
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
    """First state (5) from the data instead of Eq. 52's constants.

    Every raised sample collects the heights of the raised samples near it; the richest one is the
    centre, which a single outlier is not. Those near it stand for the feature: their share of the
    cell's area, m^2, gives sigma, their mean height over the rest its volume. ``high`` (3 raised)
    are x, y, z of each sample that stands out, one at least; all ``count`` heights of the cell sum
    to zero. ``least``: height of the lowest feature, m.
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


@cython.boundscheck(False)
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
    """Update the feature of a leaf that a run shows one in, or that had one.

    A leaf is a candidate if clearly more points stand out than noise raises on flat ground; a
    feature that later scans do not show fades away.

    Args:
        points, residual: Of the run, (3 N) about the lidar and (N) n.(r - mean), m.
        origin: (3) of the lidar, map frame, m.
        side: Of the cell, m.
        heights: Working memory, for a scan's points.
    """
    high = cython.declare(cython.double[72])
    state = cython.declare(cython.double[5])
    information = cython.declare(cython.double[25])
    cython.declare(i=cython.Py_ssize_t, k=cython.int, stride=cython.Py_ssize_t)
    cython.declare(at=cython.Py_ssize_t)
    inside: cython.Py_ssize_t = 0
    held: cython.Py_ssize_t = 0
    raised: cython.Py_ssize_t = 0
    count = run.points
    if count < rules.feature_points:
        return
    number: cython.Py_ssize_t = cython.cast(cython.Py_ssize_t, count)
    x, y, up = leaf.x - origin[0], leaf.y - origin[1], leaf.normal[2]
    known: cython.bint = isfinite(leaf.feature[1])
    gate = max(HIGH * sqrt(run.variance), 0.5 * rules.feature_height * up)
    if not known and run.max_residual > gate:
        for i in range(number):
            # A number and not a truth, which compilers do not count two at a time.
            one = 1.0 if residual[i] > gate else 0.0
            raised += cython.cast(cython.int, one)
    chance = CHANCE * count
    if not known and raised < max(2.0, chance + 2.0 * sqrt(chance)):
        return
    heights.clear(up * up / run.variance)
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
        # Eq. 52's unit covariance, of a unit that is 1 m for the vehicle of the defaults; k^2 is a
        # volume.
        unit = 10.0 * rules.feature_height
        for k in range(25):
            information[k] = 1.0 / (unit * unit) if k % 6 == 0 else 0.0
        information[6] /= unit
    reach = min(max(WINDOW * state[4], 5.0 * rules.feature_height), side)
    middle_x, middle_y = x + state[2], y + state[3]
    for i in range(number):
        # Without a branch, which nobody could foretell.
        heights.near[inside] = i
        off = max(fabs(points[3 * i] - middle_x), fabs(points[3 * i + 1] - middle_y))
        inside += off <= reach
    stride = (inside + MAX_SAMPLES - 1) // MAX_SAMPLES
    at = 0
    while at < inside:
        i = heights.near[at]
        heights.add(points[3 * i] - x, points[3 * i + 1] - y, residual[i] / up)
        at += stride
    if not known and promise(heights, state) < 0.5 * SIGNIFICANCE:
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
