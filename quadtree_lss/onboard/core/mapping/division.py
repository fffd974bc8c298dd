# SPDX-License-Identifier: Apache-2.0
"""Residual statistics of a leaf (Eq. 48, Eq. 55), and the conditions for its division (paper IV.D):
the misfit of its plane, its exceptions, and rocks."""

from __future__ import annotations

import cython
from cython.cimports.libc.math import erfc, fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry.plane import (
    inverse_symmetric,
    offset_variance,
)
from cython.cimports.quadtree_lss.onboard.core.geometry.sphere import basis_at
from cython.cimports.quadtree_lss.onboard.core.mapping.features import feature_height
from cython.cimports.quadtree_lss.onboard.core.mapping.measure import (
    has_few_points,
    is_partial,
    pose_variance,
)
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import ESTIMATED

from quadtree_lss.onboard.core.geometry.sphere import Vector
from quadtree_lss.onboard.core.mapping.measure import Rules
from quadtree_lss.onboard.core.tree.leaves import Record

#: Mean and standard deviation of chi_1, E = sqrt(2 / pi), and mean of chi_3, E = 2 sqrt(2 / pi)
#: = sqrt(2) Gamma(2) / Gamma(3/2) of Eq. 47.
MEAN_CHI_1 = cython.declare(cython.double, 0.7978845608028654)
SPREAD_CHI_1 = cython.declare(cython.double, 0.6028102749890869)
MEAN_CHI_3 = cython.declare(cython.double, 1.5957691216057308)
#: Standard errors by which the mean of the division statistic must exceed the threshold (Eq. 47).
CONFIDENCE = cython.declare(cython.double, 0.5)
#: Least number of free residuals (points minus three per scan) for a division by this mean.
MIN_RESIDUALS = cython.declare(cython.double, 8.0)
#: Standard errors by which a mean residual must exceed that of noise; it is tested after each scan.
RESIDUAL_SIGMAS = cython.declare(cython.double, 2.0)
#: Share of measurements that are exceptions because stray returns pass the outlier gate.
STRAY_SHARE = cython.declare(cython.double, 2e-4)
#: Points of a partial view are unexplained beyond so many root mean square residuals.
UNEXPLAINED_RMS = cython.declare(cython.double, 4.0)
#: Standard deviations of the misfit that are not a rock.
MISFIT_SIGMAS = cython.declare(cython.double, 4.0)
#: Stereo depths have the same errors as their neighbours: one of so many counts for exceptions.
STEREO_STRIDE = cython.declare(cython.Py_ssize_t, 4)


def normal_tail(x: cython.double) -> cython.double:
    """P(N(0, 1) > x)."""
    return 0.5 * erfc(sqrt(0.5) * x)


def mean_distance(
    points: Vector, count: cython.Py_ssize_t, normal: Vector, through: Vector
) -> cython.double:
    """Mean |n.(r - p)| (Eq. 19) of points (3 N) to the plane n (3) through p (3), m."""
    total = cython.declare(cython.double[2])
    cython.declare(i=cython.Py_ssize_t, at=cython.Py_ssize_t, k=cython.int)
    x, y, z = normal[0], normal[1], normal[2]
    d = x * through[0] + y * through[1] + z * through[2]
    total[0] = total[1] = 0.0
    # Two sums, so that additions overlap.
    for i in range(0, 3 * count - 3, 6):
        for k in range(2):
            at = i + 3 * k
            total[k] += fabs(x * points[at] + y * points[at + 1] + z * points[at + 2] - d)
    if count & 1:
        i = 3 * count - 3
        total[0] += fabs(x * points[i] + y * points[i + 1] + z * points[i + 2] - d)
    return (total[0] + total[1]) / count


def mahalanobis_factor(
    mean: Vector, cosine: float, sigma: Vector, along: float, plane: float
) -> cython.double:
    """d_M / |epsilon| of Eq. 46 for residuals along the ray, 1/m.

    The predicted point lies on the measured point's ray, so d_M = |epsilon| sqrt(u^T Sigma^-1 u) /
    |n.u| with Eq. 61's Sigma = Sigma_r + s u u^T, s = (a^T Sigma_P a) / (n.u)^2, and
    1 / (u^T Sigma^-1 u) = 1 / (u^T Sigma_r^-1 u) + s. Range noise is along the ray, too: only the
    pose's part of Eq. 17 is inverted, kept regular by a millionth of its trace.
    ``mean`` (3): of the points about the lidar, m. ``cosine``: |n.u|. ``along``:
    variance of the range. ``plane``: a^T Sigma_P a, m^2; zero for a fit's own points.
    """
    axis = cython.declare(cython.double[3])
    total = cython.declare(cython.double[9])
    inverse = cython.declare(cython.double[9])
    ray = cython.declare(cython.double[3])
    cython.declare(i=cython.int, j=cython.int)
    distance = sqrt(mean[0] * mean[0] + mean[1] * mean[1] + mean[2] * mean[2])
    for i in range(3):
        ray[i] = mean[i] / distance
    # Entries of a quadratic form from its values at e_i and e_i + e_j.
    for i in range(3):
        for j in range(3):
            axis[j] = 1.0 if i == j else 0.0
        total[4 * i] = pose_variance(axis, mean, sigma)
    for i in range(3):
        for j in range(i):
            axis[0] = axis[1] = axis[2] = 0.0
            axis[i] = axis[j] = 1.0
            both = pose_variance(axis, mean, sigma)
            total[3 * i + j] = total[3 * j + i] = 0.5 * (both - total[4 * i] - total[4 * j])
    regular = 1e-6 * (total[0] + total[4] + total[8]) + 1e-12
    for i in range(3):
        total[4 * i] += regular
    inverse_symmetric(total, inverse)
    weight = 0.0
    for i in range(3):
        for j in range(3):
            weight += ray[i] * inverse[3 * i + j] * ray[j]
    total_along = 1.0 / max(weight, 1e-300) + along + plane / (cosine * cosine)
    return 1.0 / (cosine * sqrt(total_along))


def set_statistic(rules: Rules, leaf: Record, run: Record, points: Vector, pose: Record) -> None:
    """Set the division statistic of a run with more than three points, before its fit is fused.

    By default the mean residual about the run's own fit over range noise, times sqrt(N / (N - 3)),
    of expectation E[chi_1] on planar ground. With the paper's rule the mean d_M of prefit
    residuals: about the leaf's plane if it is estimated, else about the fit. ``points`` (3 N) are
    about the lidar.
    """
    basis = cython.declare(cython.double[6])
    through = cython.declare(cython.double[3])
    cython.declare(i=cython.int, number=cython.Py_ssize_t)
    count = run.points
    number = cython.cast(cython.Py_ssize_t, count)
    if not rules.mahalanobis:
        distance = mean_distance(points, number, run.normal, run.centroid)
        run.statistic = distance * sqrt(count / ((count - 3.0) * run.variance))
        return
    along = run.variance / (run.cosine * run.cosine)
    if leaf.state != ESTIMATED:
        distance = mean_distance(points, number, run.normal, run.centroid)
        run.statistic = distance * mahalanobis_factor(
            run.centroid, run.cosine, pose.sigma, along, 0.0
        )
        return
    through[0], through[1] = leaf.x - pose.origin[0], leaf.y - pose.origin[1]
    through[2] = leaf.z - pose.origin[2]
    distance = mean_distance(points, number, leaf.normal, through)
    basis_at(leaf.normal, basis)
    for i in range(3):
        through[i] = run.centroid[i] - through[i]
    first = basis[0] * through[0] + basis[1] * through[1] + basis[2] * through[2]
    second = basis[3] * through[0] + basis[4] * through[1] + basis[5] * through[2]
    plane = offset_variance(leaf.range_part, first, second)
    plane += offset_variance(leaf.pose_part, first, second)
    run.statistic = distance * mahalanobis_factor(
        run.centroid, run.cosine, pose.sigma, along, plane
    )


def add_statistic(rules: Rules, leaf: Record, run: Record) -> None:
    """Add the division statistic of a run to the mean of its leaf (Eq. 47).

    By the paper's rule all measurements count. By default the N - 3 free residuals of each fit do,
    so that scans with four points do not outweigh a full view; partial views do not count.
    """
    if has_few_points(run) or (is_partial(run) and not rules.mahalanobis):
        return
    weight = run.points if rules.mahalanobis else run.points - 3.0
    leaf.division_sum += weight * run.statistic
    leaf.square_sum += weight * run.square
    leaf.division_weight += weight


def misfit_divides(rules: Rules, leaf: Record, run: Record) -> cython.bint:
    """Return whether the mean division statistic of a leaf exceeds the threshold.

    By default by `CONFIDENCE` standard errors, so that cells with few points are not divided by
    chance, and not after a partial view.
    """
    total = leaf.division_weight
    if rules.mahalanobis:
        return leaf.division_sum > total * rules.division_factor * MEAN_CHI_3
    if is_partial(run) or total < MIN_RESIDUALS:
        return False
    margin = CONFIDENCE * SPREAD_CHI_1 / sqrt(total)
    return leaf.division_sum > total * (rules.division_factor * MEAN_CHI_1 + margin)


def shows_rock(rules: Rules, leaf: Record) -> cython.bint:
    """Return whether a leaf holds a rock that the mean of Eq. 47 does not show.

    It shows by its exceptions (Eq. 48), `ROCK_EXCEPTIONS` measurements more than noise and stray
    returns explain, or as a feature. Lower rocks show in `ScanUpdate._shows_mound`.
    """
    noise = leaf.exception_noise
    least = max(rules.divide_exceptions, STRAY_SHARE * leaf.residuals)
    if leaf.exception_sum >= noise + max(least, 3.0 * sqrt(noise)):
        return True
    return leaf.feature[4] <= rules.rock_sigma and feature_height(leaf.feature) >= rules.rock_height


def residuals_divide(rules: Rules, leaf: Record) -> cython.bint:
    """Return whether the mean residual about a leaf's plane exceeds ``rules.division_factor`` times
    that of noise by `RESIDUAL_SIGMAS` standard errors. Finds misfits where scans have three points
    or fewer in a leaf, and no fit of their own."""
    count = leaf.residuals
    if count < MIN_RESIDUALS:
        return False
    doubt = RESIDUAL_SIGMAS * SPREAD_CHI_1 / (MEAN_CHI_1 * sqrt(count))
    return leaf.distance_sum > leaf.noise_sum * (rules.division_factor + doubt)


def misfit_square(leaf: Record, variance: float) -> cython.double:
    """Return the mean square misfit of a leaf's plane beyond noise, m^2: the larger one about the
    scans' own fits and about the plane, because a partial view fits its part well."""
    mean = leaf.distance_sum / max(leaf.residuals, 1.0) / MEAN_CHI_1
    square = max(leaf.square_sum / max(leaf.division_weight, 1.0), mean * mean)
    return max(square - variance, 0.0)


def unexplained_distance(rules: Rules, leaf: Record, variance: float) -> cython.double:
    """Return the distance from the leaf's plane beyond which a return of a partial view is
    unexplained, m."""
    usual = variance
    if leaf.division_weight > 0.0:
        usual = max(leaf.square_sum / leaf.division_weight, variance)
    return max(rules.rock_height, UNEXPLAINED_RMS * sqrt(usual))


def raised_distance(rules: Rules, leaf: Record, variance: float) -> cython.double:
    """Return the distance from the leaf's plane beyond which a return is raised, m: the height of a
    rock, on uneven ground more, at most `unexplained_distance`."""
    misfit = 0.0
    if leaf.division_weight > 0.0:
        misfit = max(leaf.square_sum / leaf.division_weight - variance, 0.0)
    curved = rules.rock_height + MISFIT_SIGMAS * sqrt(misfit)
    return min(curved, unexplained_distance(rules, leaf, variance))


def view_shows_misfit(
    rules: Rules, leaf: Record, run: Record, points: Vector, origin: Vector, side: float
) -> cython.bint:
    """Return whether a partial view of a leaf contradicts its plane before fusion, apart from an
    offset up to ``run.offset_limit``. ``points`` (3 N) are about the lidar,
    ``origin`` (3) is that in the map, ``side`` that of the leaf, m."""
    i: cython.Py_ssize_t
    n_x, n_y, n_z = leaf.normal[0], leaf.normal[1], leaf.normal[2]
    d = n_x * (leaf.x - origin[0]) + n_y * (leaf.y - origin[1]) + n_z * (leaf.z - origin[2])
    off = n_x * run.centroid[0] + n_y * run.centroid[1] + n_z * run.centroid[2] - d
    d += min(max(off, -run.offset_limit), run.offset_limit)
    high = unexplained_distance(rules, leaf, run.variance)
    out = greatest = 0.0
    for i in range(cython.cast(cython.Py_ssize_t, run.points)):
        e = fabs(n_x * points[3 * i] + n_y * points[3 * i + 1] + n_z * points[3 * i + 2] - d)
        out += 1.0 if e > high else 0.0
        greatest = greatest if greatest > e else e
    if out < max(2.0, rules.rock_area / (side * side) * run.points):
        return False
    leaf.greatest = max(leaf.greatest, min(greatest, rules.clip))
    return True


def add_residuals(
    rules: Rules, leaf: Record, run: Record, points: Vector, residual: Vector, origin: Vector
) -> None:
    """Add a run to the running statistics of its leaf.

    Write the residuals n.(r - mean) (N), m: without the scan's common offset in the cell, which
    pose error explains. With too few points for a fit, only the share p / (p + v / N) of it is
    removed, p the variance of common errors and v that of noise.
    ``points``, ``origin``: as in `view_shows_misfit`.
    """
    i: cython.Py_ssize_t
    count = run.points
    number: cython.Py_ssize_t = cython.cast(cython.Py_ssize_t, count)
    variance = run.variance
    n_x, n_y, n_z = leaf.normal[0], leaf.normal[1], leaf.normal[2]
    d = n_x * run.centroid[0] + n_y * run.centroid[1] + n_z * run.centroid[2]
    off = d - n_x * (leaf.x - origin[0]) - n_y * (leaf.y - origin[1]) - n_z * (leaf.z - origin[2])
    shared = 1.0
    if has_few_points(run):
        shared = run.common_share
    if has_few_points(run) or is_partial(run):
        d -= off - min(max(shared * off, -run.offset_limit), run.offset_limit)
    high = raised_distance(rules, leaf, variance)
    clip = rules.clip
    total = greatest = 0.0
    low = high_z = points[2]
    for i in range(number):
        z = points[3 * i + 2]
        low = low if low < z else z
        high_z = high_z if high_z > z else z
        e = n_x * points[3 * i] + n_y * points[3 * i + 1] + n_z * z - d
        residual[i] = e
        e = fabs(e)
        greatest = greatest if greatest > e else e
        total += e if e < clip else clip
    leaf.low = min(leaf.low, low + origin[2])
    leaf.high = max(leaf.high, high_z + origin[2])
    run.raised_limit = high
    run.max_residual = greatest
    leaf.greatest = max(leaf.greatest, min(greatest, clip))
    noise = variance * max(1.0 - shared / count, 0.5)
    leaf.distance_sum += total
    leaf.noise_sum += count * MEAN_CHI_1 * sqrt(noise)
    # xi of a residual that is noise itself: the noise counts twice.
    leaf.exception_noise += 2.0 * count * normal_tail(rules.tolerance / sqrt(2.0 * variance))
    if greatest > rules.tolerance - 3.0 * sqrt(noise):
        every: cython.Py_ssize_t = STEREO_STRIDE if rules.stereo > 0.0 else 1
        leaf.exception_sum += exceptions(residual, number, every, rules.tolerance, sqrt(noise))
    leaf.residuals += count


def exceptions(
    residual: Vector,
    count: cython.Py_ssize_t,
    every: cython.Py_ssize_t,
    tolerance: float,
    deviation: float,
) -> cython.double:
    """Return Eq. 48's sum of xi = P(|e + s N(0, 1)| > t), the probability mass beyond ``tolerance``
    t, for residuals e, of which every ``every``-th is used, and their ``deviation`` s from range
    noise. Without that of the plane's slope, which in a leaf that is partly observed concerns the
    other part."""
    i: cython.Py_ssize_t = 0
    asked = mass = 0.0
    while i < count:
        e = fabs(residual[i])
        if e > tolerance - 3.0 * deviation:
            mass += normal_tail((tolerance - e) / deviation)
            mass += normal_tail((tolerance + e) / deviation)
        asked += 1.0
        i += every
    return mass * (count / asked)
