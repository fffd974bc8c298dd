# SPDX-License-Identifier: Apache-2.0
"""Points that came to rest in a leaf: what its plane does not describe (Eq. 48, Eq. 55)."""

from __future__ import annotations

import cython

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.geometry.sphere import Vector
from quadtree_lss.onboard.core.mapping.measure import Rules
from quadtree_lss.onboard.core.tree.leaves import Record

if not cython.compiled:
    from math import fabs, sqrt

    from quadtree_lss.onboard.core.geometry.portable import above
    from quadtree_lss.onboard.core.mapping.measure import few, partial

#: E[chi_1] = sqrt(2 / pi).
MEAN_CHI_1 = cython.declare(cython.double, 0.7978845608028654)
#: A view of a part shows something where points lie off by so many root mean square residuals.
OUTSTANDING = cython.declare(cython.double, 4.0)
#: Of what a plane leaves out, so many deviations are no rock.
MISFITS = cython.declare(cython.double, 4.0)
#: Depths of stereo err together with their neighbours': of so many one is asked for exceptions.
ALIKE = cython.declare(cython.Py_ssize_t, 4)


def standing_out(rules: Rules, leaf: Record, variance: float) -> cython.double:
    """From which distance to its leaf's plane on a return of a view of a part stands out, m."""
    usual = variance
    if leaf.division_weight > 0.0:
        usual = max(leaf.square_sum / leaf.division_weight, variance)
    return max(rules.rock_height, OUTSTANDING * sqrt(usual))


def raised_from(rules: Rules, leaf: Record, variance: float) -> cython.double:
    """From which distance to its leaf's plane on a return that came to rest is raised, m.

    Where ground is plane that is the height of a rock, three deviations of noise at least; where
    the plane leaves something out, more, but no more than what stands out.
    """
    misfit = 0.0
    if leaf.division_weight > 0.0:
        misfit = max(leaf.square_sum / leaf.division_weight - variance, 0.0)
    curved = rules.rock_height + MISFITS * sqrt(misfit)
    return min(curved, standing_out(rules, leaf, variance))


@cython.boundscheck(False)
def departs(
    rules: Rules,
    leaf: Record,
    run: Record,
    points: Array,
    begin: cython.Py_ssize_t,
    end: cython.Py_ssize_t,
    origin: Vector,
    side: float,
) -> cython.bint:
    """Whether a view of a part of a leaf shows what the leaf's plane does not describe.

    It is held against the plane as it was before: a rock that fills the view would bend it. What
    the offset of the view may be, ``run.doubt``, is no rock.
    """
    i: cython.Py_ssize_t
    n_x, n_y, n_z = leaf.normal[0], leaf.normal[1], leaf.normal[2]
    d = n_x * (leaf.x - origin[0]) + n_y * (leaf.y - origin[1]) + n_z * (leaf.z - origin[2])
    off = n_x * run.centroid[0] + n_y * run.centroid[1] + n_z * run.centroid[2] - d
    d += min(max(off, -run.doubt), run.doubt)
    high = standing_out(rules, leaf, run.variance)
    out = greatest = 0.0
    for i in range(begin, end):
        e = fabs(n_x * points[i, 0] + n_y * points[i, 1] + n_z * points[i, 2] - d)
        out += 1.0 if e > high else 0.0
        greatest = e if e > greatest else greatest
    if out < max(2.0, rules.rock_area / (side * side) * run.points):
        return False
    leaf.greatest = max(leaf.greatest, min(greatest, rules.clip))
    return True


@cython.boundscheck(False)
def rest(
    rules: Rules,
    leaf: Record,
    run: Record,
    points: Array,
    residual: Array,
    begin: cython.Py_ssize_t,
    end: cython.Py_ssize_t,
    origin: Vector,
) -> None:
    """Add a run to the running statistics of the leaf it came to rest in.

    Residuals (N,), written from ``begin`` to ``end``, m, are n.(r - mean): without the scan's
    common offset in the cell, which pose error and not the ground explains; it takes one degree of
    freedom. Of so few points that no fit of their own tells, only the likeliest offset is taken
    out: b p / (p + v / N) for a mean b off the plane, p the variance of what they have in common
    and v that of noise. What is left of a residual has the variance v (1 - p / (N p + v)).
    """
    i: cython.Py_ssize_t
    count = run.points
    variance = run.variance
    n_x, n_y, n_z = leaf.normal[0], leaf.normal[1], leaf.normal[2]
    d = n_x * run.centroid[0] + n_y * run.centroid[1] + n_z * run.centroid[2]
    off = d - n_x * (leaf.x - origin[0]) - n_y * (leaf.y - origin[1]) - n_z * (leaf.z - origin[2])
    shared = 1.0
    if few(run):
        shared = run.shared
    if few(run) or partial(run):
        d -= off - min(max(shared * off, -run.doubt), run.doubt)
    high = raised_from(rules, leaf, variance)
    clip = rules.clip
    total = greatest = 0.0
    low = high_z = points[begin, 2]
    for i in range(begin, end):
        z = points[i, 2]
        low = z if z < low else low
        high_z = z if z > high_z else high_z
        e = n_x * points[i, 0] + n_y * points[i, 1] + n_z * z - d
        residual[i] = e
        e = fabs(e)
        greatest = e if e > greatest else greatest
        total += e if e < clip else clip
    leaf.low = min(leaf.low, low + origin[2])
    leaf.high = max(leaf.high, high_z + origin[2])
    run.raised_by = high
    run.greatest = greatest
    leaf.greatest = max(leaf.greatest, min(greatest, clip))
    noise = variance * max(1.0 - shared / count, 0.5)
    leaf.distance_sum += total
    leaf.noise_sum += count * MEAN_CHI_1 * sqrt(noise)
    # xi of a residual that is noise itself: the noise counts twice.
    leaf.exception_noise += 2.0 * count * above(rules.tolerance / sqrt(2.0 * variance))
    if greatest > rules.tolerance - 3.0 * sqrt(noise):
        every: cython.Py_ssize_t = ALIKE if rules.stereo > 0.0 else 1
        leaf.exception_sum += exceptions(residual, begin, end, every, rules.tolerance, sqrt(noise))
    leaf.residuals += count


@cython.boundscheck(False)
def exceptions(
    residual: Array,
    begin: cython.Py_ssize_t,
    end: cython.Py_ssize_t,
    every: cython.Py_ssize_t,
    tolerance: float,
    deviation: float,
) -> cython.double:
    """Eq. 48's sum of xi: probability mass beyond the roughness tolerance t.

    xi = P(|e + s N(0, 1)| > t) with e the residual (N,), m, of the run ``begin`` to ``end``, of
    which one of ``every`` so many stands for all, and s the ``deviation`` that range noise leaves
    in it, m. How uncertain the plane's slope is does not count: of a leaf that was seen in part
    that is the other part's.
    """
    i: cython.Py_ssize_t = begin
    asked = mass = 0.0
    while i < end:
        e = fabs(residual[i])
        if e > tolerance - 3.0 * deviation:
            mass += above((tolerance - e) / deviation) + above((tolerance + e) / deviation)
        asked += 1.0
        i += every
    return mass * ((end - begin) / asked)
