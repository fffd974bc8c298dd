# SPDX-License-Identifier: Apache-2.0
"""What a cell's plane does not describe (Eq. 48, Eq. 55), and when that divides the cell (paper
IV.D): two criteria, and rocks."""

from __future__ import annotations

import cython
from cython.cimports.libc.math import erfc, fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry.plane import inverse_symmetric
from cython.cimports.quadtree_lss.onboard.core.geometry.sphere import basis_at
from cython.cimports.quadtree_lss.onboard.core.mapping.features import feature_height
from cython.cimports.quadtree_lss.onboard.core.mapping.measure import few, partial, pose_variance
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import MEASURED

from quadtree_lss.onboard.core.geometry.sphere import Vector
from quadtree_lss.onboard.core.mapping.measure import Rules
from quadtree_lss.onboard.core.tree.leaves import Record

#: Mean and standard deviation of chi_1, E = sqrt(2 / pi), and of chi_3, E = 2 sqrt(2 / pi)
#: = sqrt(2) Gamma(2) / Gamma(3/2) of Eq. 47.
MEAN_CHI_1 = cython.declare(cython.double, 0.7978845608028654)
SPREAD_CHI_1 = cython.declare(cython.double, 0.6028102749890869)
MEAN_CHI_3 = cython.declare(cython.double, 1.5957691216057308)
SPREAD_CHI_3 = cython.declare(cython.double, 0.6734368740430634)
#: Mean residuals are looked at after each scan: by so many deviations they must exceed what noise
#: makes of them.
SURE = cython.declare(cython.double, 2.0)
#: Share of measurements that stray returns, let through by the outlier gate, make exceptions.
STRAY = cython.declare(cython.double, 2e-4)
#: A view of a part shows something where points lie off by so many root mean square residuals.
OUTSTANDING = cython.declare(cython.double, 4.0)
#: Of what a plane leaves out, so many deviations are no rock.
MISFITS = cython.declare(cython.double, 4.0)
#: Depths of stereo err together with their neighbours': of so many one is asked for exceptions.
ALIKE = cython.declare(cython.Py_ssize_t, 4)


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
    # Two sums side by side: one would wait for itself.
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

    The predicted point lies on the measured point's ray, so r_hat - r_bar = epsilon u / (n.u) and
    d_M = |epsilon| sqrt(u^T Sigma^-1 u) / |n.u| with Eq. 61's Sigma = Sigma_r + s u u^T,
    s = (a^T Sigma_P a) / (n.u)^2. What is added along the ray adds to the variance there,
    1 / (u^T Sigma^-1 u) = 1 / (u^T Sigma_r^-1 u) + s, and so does range noise: only the pose's part
    of Eq. 17, J Sigma_pose J^T with J = (I, -[r - m]_x), is inverted, kept regular by a millionth
    of its trace.

    Args:
        mean: (3) of the points about the lidar, m.
        cosine: |n.u|.
        sigma: (36) pose covariance.
        along: Variance of the range, m^2.
        plane: a^T Sigma_P a, m^2; zero for a fit's own points.
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


def judge(
    rules: Rules,
    leaf: Record,
    run: Record,
    points: Vector,
    origin: Vector,
    sigma: Vector,
) -> None:
    """The division statistic of a run that is not `few`, before its fit is fused.

    ``lack_of_fit``: mean residual about the run's own fit over range noise, with sqrt(N / (N - 3)),
    of expectation E[chi_1] on planar ground. ``mahalanobis``: the paper's mean d_M of prefit
    residuals; a measured leaf is judged by the plane it had, a new one by its fit ("the fit quality
    between measurements and the initial estimate"). ``points`` (3 N) are about the lidar,
    ``origin`` (3) is that in the map, m.
    """
    basis = cython.declare(cython.double[6])
    through = cython.declare(cython.double[3])
    row = cython.declare(cython.double[3])
    cython.declare(i=cython.int, j=cython.int, number=cython.Py_ssize_t)
    count = run.points
    number = cython.cast(cython.Py_ssize_t, count)
    if not rules.mahalanobis:
        distance = mean_distance(points, number, run.normal, run.centroid)
        run.statistic = distance * sqrt(count / ((count - 3.0) * run.variance))
        return
    along = run.variance / (run.cosine * run.cosine)
    if leaf.known != MEASURED:
        distance = mean_distance(points, number, run.normal, run.centroid)
        run.statistic = distance * mahalanobis_factor(run.centroid, run.cosine, sigma, along, 0.0)
        return
    through[0], through[1] = leaf.x - origin[0], leaf.y - origin[1]
    through[2] = leaf.z - origin[2]
    distance = mean_distance(points, number, leaf.normal, through)
    basis_at(leaf.normal, basis)
    for i in range(3):
        through[i] = run.centroid[i] - through[i]
    row[0] = -(basis[0] * through[0] + basis[1] * through[1] + basis[2] * through[2])
    row[1] = -(basis[3] * through[0] + basis[4] * through[1] + basis[5] * through[2])
    row[2] = 1.0
    plane = 0.0
    for i in range(3):
        for j in range(3):
            total = leaf.range_part[3 * i + j] + leaf.pose_part[3 * i + j]
            plane += row[i] * total * row[j]
    run.statistic = distance * mahalanobis_factor(run.centroid, run.cosine, sigma, along, plane)


def asks(rules: Rules, leaf: Record, run: Record) -> cython.bint:
    """Update the running mean of a leaf's division statistic; whether it asks to be divided.

    The mean is over all processed measurements (Eq. 47). A scan counts by the residuals that its
    fit left free, N - 3: near the edge of a scan cells get four or five points at a time, and the
    single free residual of many such scans would outvote one full view. A mean of n residuals
    scatters by its chi distribution's deviation over sqrt(n); it must exceed the threshold by
    `CONFIDENCE` of these, or cells with few points would divide by chance. A view of
    less than half of the cell does not judge it: no corner outvotes the whole.
    """
    if partial(run):
        return False
    weight = max(run.points - 3.0, 0.0)
    leaf.division_sum += weight * run.statistic
    leaf.square_sum += weight * run.square
    leaf.division_weight += weight
    total = leaf.division_weight
    if total < rules.min_residuals:
        return False
    expected = MEAN_CHI_3 if rules.mahalanobis else MEAN_CHI_1
    spread = SPREAD_CHI_3 if rules.mahalanobis else SPREAD_CHI_1
    doubt = rules.division_confidence * spread / sqrt(total)
    return leaf.division_sum > total * (rules.division_factor * expected + doubt)


def hides_rock(rules: Rules, leaf: Record) -> cython.bint:
    """Whether a leaf holds a rock, which the mean over a large leaf hides.

    A rock of twenty points among ten thousand does not move Eq. 47's mean. It shows by its
    exceptions (Eq. 48), if beyond what noise makes of them they amount to `ROCK_EXCEPTIONS`
    measurements and to more than stray returns leave; or as a feature as high and narrow as a
    rock. A leaf has one feature, and what is lower than an exception shows in the pile of a finest
    cell (`ScanUpdate._mound`).
    """
    noise = leaf.exception_noise
    least = max(rules.divide_exceptions, STRAY * leaf.residuals)
    if leaf.exception_sum >= noise + max(least, 3.0 * sqrt(noise)):
        return True
    return leaf.feature[4] <= rules.rock_sigma and feature_height(leaf.feature) >= rules.rock_height


def rough(rules: Rules, leaf: Record) -> cython.bint:
    """Whether points that came to rest lie farther from a leaf's plane than noise puts them.

    The mean of n residuals must be over ``rules.division_factor`` times that of noise, by `SURE` of
    its deviations. Where scans leave three points and fewer in a leaf, no fit of their own tells.
    """
    count = leaf.residuals
    if rules.mahalanobis or count < rules.min_residuals:
        return False
    doubt = SURE * SPREAD_CHI_1 / (MEAN_CHI_1 * sqrt(count))
    return leaf.distance_sum > leaf.noise_sum * (rules.division_factor + doubt)


def left_out(leaf: Record, variance: float) -> cython.double:
    """Mean square of what a leaf's plane leaves out, beyond what noise makes of residuals, m^2.

    Of those about the scans' own fits, or about the plane: a scan that sees a part fits it well.
    """
    mean = leaf.distance_sum / max(leaf.residuals, 1.0) / MEAN_CHI_1
    square = max(leaf.square_sum / max(leaf.division_weight, 1.0), mean * mean)
    return max(square - variance, 0.0)


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


def departs(
    rules: Rules, leaf: Record, run: Record, points: Vector, origin: Vector, side: float
) -> cython.bint:
    """Whether a view of a part of a leaf shows what the leaf's plane does not describe.

    It is held against the plane as it was before: a rock that fills the view would bend it. What
    the offset of the view may be, ``run.doubt``, is no rock. ``points``, ``origin``: as of `judge`.
    ``side``: of the leaf, m.
    """
    i: cython.Py_ssize_t
    n_x, n_y, n_z = leaf.normal[0], leaf.normal[1], leaf.normal[2]
    d = n_x * (leaf.x - origin[0]) + n_y * (leaf.y - origin[1]) + n_z * (leaf.z - origin[2])
    off = n_x * run.centroid[0] + n_y * run.centroid[1] + n_z * run.centroid[2] - d
    d += min(max(off, -run.doubt), run.doubt)
    high = standing_out(rules, leaf, run.variance)
    out = greatest = 0.0
    for i in range(cython.cast(cython.Py_ssize_t, run.points)):
        e = fabs(n_x * points[3 * i] + n_y * points[3 * i + 1] + n_z * points[3 * i + 2] - d)
        out += 1.0 if e > high else 0.0
        greatest = greatest if greatest > e else e
    if out < max(2.0, rules.rock_area / (side * side) * run.points):
        return False
    leaf.greatest = max(leaf.greatest, min(greatest, rules.clip))
    return True


def rest(
    rules: Rules, leaf: Record, run: Record, points: Vector, residual: Vector, origin: Vector
) -> None:
    """Add a run to the running statistics of the leaf it came to rest in.

    Residuals (N), which are written, m, are n.(r - mean): without the scan's common offset in the
    cell, which pose error and not the ground explains; it takes one degree of freedom. Of so few
    points that no fit of their own tells, only the likeliest offset is taken out: b p / (p + v / N)
    for a mean b off the plane, p the variance of what they have in common and v that of noise. What
    is left of a residual has the variance v (1 - p / (N p + v)). ``points``, ``origin``: as of
    `judge`.
    """
    i: cython.Py_ssize_t
    count = run.points
    number: cython.Py_ssize_t = cython.cast(cython.Py_ssize_t, count)
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
    run.raised_by = high
    run.greatest = greatest
    leaf.greatest = max(leaf.greatest, min(greatest, clip))
    noise = variance * max(1.0 - shared / count, 0.5)
    leaf.distance_sum += total
    leaf.noise_sum += count * MEAN_CHI_1 * sqrt(noise)
    # xi of a residual that is noise itself: the noise counts twice.
    leaf.exception_noise += 2.0 * count * normal_tail(rules.tolerance / sqrt(2.0 * variance))
    if greatest > rules.tolerance - 3.0 * sqrt(noise):
        every: cython.Py_ssize_t = ALIKE if rules.stereo > 0.0 else 1
        leaf.exception_sum += exceptions(residual, number, every, rules.tolerance, sqrt(noise))
    leaf.residuals += count


def exceptions(
    residual: Vector,
    count: cython.Py_ssize_t,
    every: cython.Py_ssize_t,
    tolerance: float,
    deviation: float,
) -> cython.double:
    """Eq. 48's sum of xi: probability mass beyond the roughness tolerance t.

    xi = P(|e + s N(0, 1)| > t) with e the ``count`` residuals of a run, m, of which one of
    ``every`` so many stands for all, and s the ``deviation`` that range noise leaves in it, m. How
    uncertain the plane's slope is does not count: of a leaf that was seen in part that is the other
    part's.
    """
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
