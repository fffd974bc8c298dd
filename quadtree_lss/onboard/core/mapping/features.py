# SPDX-License-Identifier: Apache-2.0
"""Subscale features: one bell in a leaf, smaller than the leaf (paper V.C).

Heights are above the cell's plane, so that a slope is no feature. The state is Eq. 51's
(A, k, mu_x, mu_y, sigma), the centre relative to the cell's; the height over the plane is
A + p exp(-r^2 / 2 sigma^2) with p = k^2 / (2 pi sigma^2) (`geometry.feature`).
"""

from __future__ import annotations

import cython

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.geometry.sphere import Vector
from quadtree_lss.onboard.core.mapping.bell import Heights
from quadtree_lss.onboard.core.mapping.measure import Rules
from quadtree_lss.onboard.core.tree.leaves import Record

if not cython.compiled:
    from math import exp, fabs, isfinite, nan, sqrt

    from quadtree_lss.onboard.core.mapping.bell import estimate, feature_height, promise

    NAN = nan


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
    raised: cython.Py_ssize_t,
    high: Vector,
    count: float,
    area: float,
    out: Vector,
) -> None:
    """First state (5) from the data instead of Eq. 52's constants.

    Every raised sample collects the heights of the raised samples near it; the richest one is the
    centre, which a single outlier is not. Those near it stand for the feature: their share of the
    cell's area gives sigma, their mean height over the rest its volume.

    Args:
        raised: Samples that stand out, one at least.
        high: (3 raised) x, y, z of each.
        count: Samples in the cell; their heights sum to zero.
        area: Of the cell, m^2.
        out: Written.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    best: cython.Py_ssize_t = 0
    width = max(1.5 * sqrt(area / count), 0.1)
    most = -1.0
    for i in range(raised):
        collected = 0.0
        for j in range(raised):
            dx = high[3 * i] - high[3 * j]
            dy = high[3 * i + 1] - high[3 * j + 1]
            collected += high[3 * j + 2] * exp(-0.5 * (dx * dx + dy * dy) / (width * width))
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
    out[1] = sqrt(max(total / many - level, 1e-3) * footprint)
    out[2] = high[3 * best]
    out[3] = high[3 * best + 1]
    out[4] = sqrt(footprint / (2.0 * PI))


@cython.boundscheck(False)
def update_feature(
    rules: Rules,
    leaf: Record,
    points: Array,
    residual: Array,
    begin: cython.Py_ssize_t,
    end: cython.Py_ssize_t,
    x: float,
    y: float,
    side: float,
    variance: float,
    greatest: float,
    heights: Heights,
) -> None:
    """Update the feature of a leaf that a scan shows one in, or that had one.

    A leaf is a candidate if clearly more points stand out than noise raises on flat ground; a
    feature that later scans do not show fades away.

    Args:
        rules: Limits.
        leaf: Record of type `LEAF`; its feature is replaced.
        points: (N, 3) about the lidar, m; the leaf's are ``begin`` to ``end``.
        residual: (N,) n.(r - mean) of each, m.
        x, y: Cell's centre about the lidar, m.
        side: Of the cell, m.
        variance: Of a residual from range noise, m^2.
        greatest: |residual|, m.
        heights: Working memory, for a scan's points.
    """
    high = cython.declare(cython.double[72])
    state = cython.declare(cython.double[5])
    information = cython.declare(cython.double[25])
    cython.declare(i=cython.Py_ssize_t, k=cython.int, stride=cython.Py_ssize_t)
    inside: cython.Py_ssize_t = 0
    held: cython.Py_ssize_t = 0
    raised: cython.Py_ssize_t = 0
    count: cython.double = end - begin
    up = leaf.normal[2]
    known: cython.bint = isfinite(leaf.feature[1])
    if count < rules.feature_points:
        return
    gate = max(HIGH * sqrt(variance), 0.5 * rules.feature_height * up)
    if not known and greatest > gate:
        for i in range(begin, end):
            raised += residual[i] > gate
    chance = CHANCE * count
    if not known and raised < max(2.0, chance + 2.0 * sqrt(chance)):
        return
    heights.clear(up * up / variance)
    if known:
        for k in range(5):
            state[k] = leaf.feature[k]
        for k in range(25):
            information[k] = leaf.feature_information[k]
    else:
        for i in range(begin, end):
            if residual[i] > gate:
                held = insert_high(high, held, points[i, 0] - x, points[i, 1] - y, residual[i] / up)
        first_state(held, high, count, side * side, state)
        # Eq. 52's unit covariance.
        for k in range(25):
            information[k] = 1.0 if k % 6 == 0 else 0.0
    reach = min(max(WINDOW * state[4], 0.5), side)
    if end - begin > MAX_SAMPLES:
        for i in range(begin, end):
            dx = points[i, 0] - x
            dy = points[i, 1] - y
            inside += fabs(dx - state[2]) <= reach and fabs(dy - state[3]) <= reach
    stride = max((inside + MAX_SAMPLES - 1) // MAX_SAMPLES, 1)
    inside = 0
    for i in range(begin, end):
        dx = points[i, 0] - x
        dy = points[i, 1] - y
        if fabs(dx - state[2]) <= reach and fabs(dy - state[3]) <= reach:
            if inside % stride == 0:
                heights.add(dx, dy, residual[i] / up)
            inside += 1
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
