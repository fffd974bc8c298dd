# SPDX-License-Identifier: Apache-2.0
"""Planes: fit to points, error covariance and fusion of two estimates (paper IV.A to IV.C).

A plane is n.(r - c) = d about an origin c near the ground (Eq. 18) with its normal up. Its error is
e = (dphi_1, dphi_2, dd): dphi in the tangent at n, axes of Eq. 2, rad; dd in m. Here d is zero: c
is the cell's centre at the plane's height. Matrices are flat, row by row: a covariance has nine
numbers, a basis of the tangent six (the first axis, then the second), a scatter six (xx, xy, xz,
yy, yz, zz). Two covariances C and D side by side are a pair (18): C_0, D_0, C_1, D_1, ...
`PlaneParts` points to a normal and to the covariances from range noise and from pose error.
"""

from __future__ import annotations

from typing import Any

import cython
from cython.cimports.libc.math import sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry.sphere import basis_at, minus_at, plus_at

from quadtree_lss.onboard.core.geometry.sphere import Vector

#: Least n_z of a normal (75.5 deg): an elevation map has no walls, steeper planes are tilted back.
MIN_UP = cython.declare(cython.double, 0.25)
#: Least variance of a plane, rad^2 and m^2: below, round-off dominates.
MIN_VARIANCE = cython.declare(cython.double, 1e-12)
#: Squared distance of a shift of the origin beyond which rounding shows in a covariance, m^2.
FAR_SQUARED = cython.declare(cython.double, 1e6)
#: Least information of a fit on a slope, rad^-2.
MIN_INFORMATION = cython.declare(cython.double, 1e-2)


def interleave(c: Vector, d: Vector, out: Vector) -> None:
    """Interleave two 3x3 matrices to a pair (18), on which the operations on both vectorise."""
    k: cython.int
    for k in range(9):
        out[2 * k] = c[k]
        out[2 * k + 1] = d[k]


def congruent(a: Vector, pair: Vector, out: Vector) -> None:
    """Compute the pair A C A^T, A D A^T of symmetric C and D, symmetric to the last bit."""
    half = cython.declare(cython.double[18])
    cython.declare(i=cython.int, j=cython.int, k=cython.int)
    for i in range(3):
        x, y, z = a[3 * i], a[3 * i + 1], a[3 * i + 2]
        for j in range(3):
            for k in range(2 * j, 2 * j + 2):
                # The transpose of A C, so that its columns are contiguous.
                half[4 * j + 2 * i + k] = x * pair[k] + y * pair[6 + k] + z * pair[12 + k]
    for i in range(3):
        x, y, z = a[3 * i], a[3 * i + 1], a[3 * i + 2]
        for k in range(6):
            out[6 * i + k] = half[k] * x + half[6 + k] * y + half[12 + k] * z
    for k in range(2):
        out[2 + k] = out[6 + k]
        out[4 + k] = out[12 + k]
        out[10 + k] = out[14 + k]


def inverse_symmetric(c: Vector, out: Vector) -> None:
    """Invert a symmetric positive definite matrix, scaled to a unit diagonal, by its cofactors. A
    singular one has a large finite inverse."""
    x = 1.0 / sqrt(max(c[0], 1e-24))
    y = 1.0 / sqrt(max(c[4], 1e-24))
    z = 1.0 / sqrt(max(c[8], 1e-24))
    xy = min(max(c[1] * x * y, -1.0), 1.0)
    xz = min(max(c[2] * x * z, -1.0), 1.0)
    yz = min(max(c[5] * y * z, -1.0), 1.0)
    first = 1.0 - yz * yz
    second = xz * yz - xy
    third = xy * yz - xz
    share = 1.0 / max(first + xy * second + xz * third, 1e-14)
    out[0] = share * x * x * first
    out[1] = out[3] = share * x * y * second
    out[2] = out[6] = share * x * z * third
    out[4] = share * y * y * (1.0 - xz * xz)
    out[5] = out[7] = share * y * z * (xy * xz - yz)
    out[8] = share * z * z * (1.0 - xy * xy)


def turn_tangent(c: Vector, change: Vector, count: cython.int) -> None:
    """Transform dphi of ``count`` interleaved covariances (9 count) by the ``change`` (4) of
    `minus_at`, in place."""
    k: cython.int
    for k in range(count):
        x = change[0] * c[k] + change[1] * c[3 * count + k]
        y = change[0] * c[count + k] + change[1] * c[4 * count + k]
        z = change[2] * c[count + k] + change[3] * c[4 * count + k]
        w = change[2] * c[k] + change[3] * c[3 * count + k]
        c[k] = x * change[0] + y * change[1]
        c[count + k] = c[3 * count + k] = x * change[2] + y * change[3]
        c[4 * count + k] = w * change[2] + z * change[3]
        x = change[0] * c[2 * count + k] + change[1] * c[5 * count + k]
        y = change[2] * c[2 * count + k] + change[3] * c[5 * count + k]
        c[2 * count + k] = c[6 * count + k] = x
        c[5 * count + k] = c[7 * count + k] = y


def shift_origin(c: Vector, first: float, second: float, count: cython.int) -> None:
    """Move the origin of ``count`` interleaved covariances (9 count) by delta, in place;
    B^T delta = (first, second), m.

    d' = d - n.delta, and as dn = B dphi, dd' = dd - (B^T delta).dphi. For a move straight up by h,
    B^T delta = -h (n_x, n_y).
    """
    k: cython.int
    for k in range(count):
        x = first * c[k] + second * c[count + k]
        y = first * c[3 * count + k] + second * c[4 * count + k]
        away = first * (x - 2.0 * c[2 * count + k])
        c[8 * count + k] += away + second * (y - 2.0 * c[5 * count + k])
        c[2 * count + k] = c[6 * count + k] = c[2 * count + k] - x
        c[5 * count + k] = c[7 * count + k] = c[5 * count + k] - y


def uncorrelate(c: Vector, i: cython.int, variance: float) -> None:
    """Set the variance of one of the three errors of a covariance (9), uncorrelated."""
    k: cython.int
    for k in range(3):
        c[3 * i + k] = c[3 * k + i] = 0.0
    c[4 * i] = variance


def offset_variance(c: Vector, first: float, second: float) -> cython.double:
    """Compute the variance of dd after `shift_origin`, m^2: of the plane's height elsewhere."""
    x = first * c[0] + second * c[1]
    y = first * c[3] + second * c[4]
    return c[8] + first * (x - 2.0 * c[2]) + second * (y - 2.0 * c[5])


def moments(points: Vector, count: cython.Py_ssize_t, mean: Vector, scatter: Vector) -> None:
    """Compute centroid (3), m, and scatter (6), m^2, of points (3 N), by sums about the first."""
    total = cython.declare(cython.double[18])
    cython.declare(i=cython.Py_ssize_t, k=cython.int)
    x0, y0, z0 = points[0], points[1], points[2]
    if count == 1:
        mean[0], mean[1], mean[2] = x0, y0, z0
        for i in range(6):
            scatter[i] = 0.0
        return
    for i in range(18):
        total[i] = 0.0
    # Two points at a time, with interleaved sums.
    for i in range(0, 3 * count - 3, 6):
        for k in range(2):
            x = points[i + 3 * k] - x0
            y = points[i + 3 * k + 1] - y0
            z = points[i + 3 * k + 2] - z0
            total[k] += x
            total[2 + k] += y
            total[4 + k] += z
            total[6 + k] += x * x
            total[8 + k] += x * y
            total[10 + k] += x * z
            total[12 + k] += y * y
            total[14 + k] += y * z
            total[16 + k] += z * z
    for i in range(9):
        total[i] = total[2 * i] + total[2 * i + 1]
    if count & 1:
        x, y, z = points[3 * count - 3] - x0, points[3 * count - 2] - y0, points[3 * count - 1] - z0
        total[0] += x
        total[1] += y
        total[2] += z
        total[3] += x * x
        total[4] += x * y
        total[5] += x * z
        total[6] += y * y
        total[7] += y * z
        total[8] += z * z
    share = 1.0 / count
    sx, sy, sz = total[0], total[1], total[2]
    mean[0], mean[1], mean[2] = x0 + share * sx, y0 + share * sy, z0 + share * sz
    scatter[0] = max(total[3] - share * sx * sx, 0.0)
    scatter[1] = total[4] - share * sx * sy
    scatter[2] = total[5] - share * sx * sz
    scatter[3] = max(total[6] - share * sy * sy, 0.0)
    scatter[4] = total[7] - share * sy * sz
    scatter[5] = max(total[8] - share * sz * sz, 0.0)


def height_normal(
    scatter: Vector, slope_x: float, slope_y: float, spread: float, normal: Vector
) -> None:
    """Compute the normal (3) by regression of height on (x, y) with a weak prior on the slope.

    (S_xy + s I)(a, b) = S_xz + s (a, b)_prior, with the within-scan scatter S and the ``spread``
    s, m^2, minimises sum (z - z0 - a x - b y)^2 + s |(a, b) - (a, b)_prior|^2.
    """
    xx = scatter[0] + spread
    yy = scatter[3] + spread
    xz = scatter[2] + spread * slope_x
    yz = scatter[4] + spread * slope_y
    share = 1.0 / (xx * yy - scatter[1] * scatter[1])
    a = share * (yy * xz - scatter[1] * yz)
    b = share * (xx * yz - scatter[1] * xz)
    up = 1.0 / sqrt(a * a + b * b + 1.0)
    normal[0], normal[1], normal[2] = -a * up, -b * up, up
    orient_up(normal)


def line_normal(
    scatter: Vector, prior: Vector, along: float, spread: float, normal: Vector, line: Vector
) -> None:
    """Compute the normal (3) of points on a line: along it their slope, across it the ``prior``'s.

    The line has the direction l in (x, y). A weak prior on the slope (a, b) changes l.(a, b) by
    (S_lz - S_ll l.(a, b)_prior) / (S_ll + s). ``along``: S_ll, the greater eigenvalue of the
    scatter's (x, y), m^2. ``spread``: s, m^2. ``line``: set to the scatter (6) without the part
    across l.
    """
    # The longer of two forms of the eigenvector, which is not affected by cancellation.
    x = along - scatter[3] if scatter[0] >= scatter[3] else scatter[1]
    y = scatter[1] if scatter[0] >= scatter[3] else along - scatter[0]
    share = 1.0 / max(sqrt(x * x + y * y), 1e-300)
    x *= share
    y *= share
    a = -prior[0] / prior[2]
    b = -prior[1] / prior[2]
    change = x * scatter[2] + y * scatter[4] - along * (x * a + y * b)
    change /= along + spread
    a += change * x
    b += change * y
    up = 1.0 / sqrt(a * a + b * b + 1.0)
    normal[0], normal[1], normal[2] = -a * up, -b * up, up
    orient_up(normal)
    line[0], line[1], line[3] = along * x * x, along * x * y, along * y * y


def orient_up(normal: Vector) -> None:
    """Orient a unit normal (3) upward, in place, with n_z of at least `MIN_UP` (Eq. 9)."""
    if normal[2] < 0.0:
        normal[0], normal[1], normal[2] = -normal[0], -normal[1], -normal[2]
    if normal[2] < MIN_UP:
        level = sqrt(1.0 - MIN_UP * MIN_UP) / max(
            sqrt(normal[0] * normal[0] + normal[1] * normal[1]), 1e-300
        )
        normal[0] *= level
        normal[1] *= level
        normal[2] = MIN_UP


def _quadratic(scatter: Vector, a: Vector, b: Vector) -> float:
    """Compute a^T S b of a scatter (6)."""
    return (
        a[0] * (scatter[0] * b[0] + scatter[1] * b[1] + scatter[2] * b[2])
        + a[1] * (scatter[1] * b[0] + scatter[3] * b[1] + scatter[4] * b[2])
        + a[2] * (scatter[2] * b[0] + scatter[4] * b[1] + scatter[5] * b[2])
    )


def orthogonal_normal(scatter: Vector, normal: Vector) -> None:
    """Improve a normal (3) by the paper's ML fit: Newton's method on the sphere, in place.

    Eq. 23, Eq. 24 and Eq. 25 are the cost, Eq. 26, Eq. 27, Eq. 28, Eq. 29, Eq. 30 and Eq. 31 its
    linearisation, Eq. 32, Eq. 33, Eq. 34 and Eq. 35 the normal equations, Eq. 36 the step. With
    one free offset gamma_j per scan (Eq. 20, Eq. 21; of one scan, d is its gamma: Eq. 22) and
    weights constant in a (cell, scan), the cost of Eq. 25 is n^T S n / 2 with S the within-scan
    scatter times 1 / (n^T Sigma n). With B the tangent basis at n: gradient B^T S n, Hessian
    B^T S B - (n^T S n) I, or the B^T S B of Eq. 33 where that is not positive definite.
    """
    basis = cython.declare(cython.double[6])
    step = cython.declare(cython.double[2])
    first = cython.declare(cython.p_double, cython.address(basis[0]))
    second = cython.declare(cython.p_double, cython.address(basis[3]))
    for _ in range(4):
        basis_at(normal, basis)
        cost = _quadratic(scatter, normal, normal)
        g0 = _quadratic(scatter, first, normal)
        g1 = _quadratic(scatter, second, normal)
        h00 = _quadratic(scatter, first, first) - cost
        h11 = _quadratic(scatter, second, second) - cost
        h01 = _quadratic(scatter, first, second)
        if h00 <= 0.0 or h00 * h11 - h01 * h01 <= 0.0:
            h00 += cost
            h11 += cost
        determinant = max(h00 * h11 - h01 * h01, 1e-300)
        step[0] = -(h11 * g0 - h01 * g1) / determinant
        step[1] = -(h00 * g1 - h01 * g0) / determinant
        short = min(1.0, 0.5 / max(sqrt(step[0] * step[0] + step[1] * step[1]), 1e-300))
        step[0] *= short
        step[1] *= short
        plus_at(normal, basis, step, normal)
        orient_up(normal)


def slope_covariance(scatter: Vector, normal: Vector, variance: float, out: Vector) -> None:
    """Compute the covariance (4) of dphi, the phi block of H^-1 (Eq. 35).

    H = M S_xy M^T / variance + `MIN_INFORMATION` I, where M = I + kappa kappa^T / (lambda (1 +
    lambda)) maps steps in x and y to steps along the plane in its tangent basis.
    """
    share = 1.0 / (normal[2] * (1.0 + normal[2]))
    m00 = 1.0 + share * normal[0] * normal[0]
    m11 = 1.0 + share * normal[1] * normal[1]
    m01 = share * normal[0] * normal[1]
    x0 = m00 * scatter[0] + m01 * scatter[1]
    x1 = m00 * scatter[1] + m01 * scatter[3]
    y0 = m01 * scatter[0] + m11 * scatter[1]
    y1 = m01 * scatter[1] + m11 * scatter[3]
    h00 = (x0 * m00 + x1 * m01) / variance + MIN_INFORMATION
    h01 = (x0 * m01 + x1 * m11) / variance
    h11 = (y0 * m01 + y1 * m11) / variance + MIN_INFORMATION
    # At least the determinant of points on a line: round-off can make it 0 or negative.
    share = 1.0 / max(h00 * h11 - h01 * h01, MIN_INFORMATION * (h00 + h11 - MIN_INFORMATION))
    out[0] = share * h11
    out[1] = out[2] = -share * h01
    out[3] = share * h00


def covariance_about(
    slope: Vector, offset_variance: float, first: float, second: float, out: Vector
) -> None:
    """Compute the covariance (9) of (dphi, dd) about an origin away from the points' centroid.

    With dphi of covariance ``slope`` (4) and the centroid's offset dd_0 independent, dd = dd_0 +
    lever.dphi, with the lever B^T (centroid - origin) = (first, second), m.
    """
    x = slope[0] * first + slope[1] * second
    y = slope[2] * first + slope[3] * second
    out[0], out[1], out[2] = slope[0], slope[1], x
    out[3], out[4], out[5] = slope[2], slope[3], y
    out[6], out[7], out[8] = x, y, offset_variance + first * x + second * y


def pose_part(normal: Vector, basis: Vector, arm: Vector, sigma: Vector, out: Vector) -> None:
    """Compute the covariance (9) of a plane due to the pose error of its scan, J Sigma_pose J^T.

    A rigid motion (dm, dw), m and rad, of covariance ``sigma`` (36) about map axes changes n by
    dw x n and moves the plane's point at the origin, ``arm`` (3) from the lidar, by dm + dw x arm:
    dphi = B^T (dw x n) and dd = n.dm + (arm x n).dw.
    """
    turn = cython.declare(cython.double[3])
    moved = cython.declare(cython.double[6])
    slope = cython.declare(cython.double[6])
    k: cython.int
    turn[0] = arm[1] * normal[2] - arm[2] * normal[1]
    turn[1] = arm[2] * normal[0] - arm[0] * normal[2]
    turn[2] = arm[0] * normal[1] - arm[1] * normal[0]
    # Sigma is symmetric.
    for k in range(6):
        first = sigma[k] * normal[0] + sigma[18 + k] * turn[0]
        second = sigma[6 + k] * normal[1] + sigma[24 + k] * turn[1]
        third = sigma[12 + k] * normal[2] + sigma[30 + k] * turn[2]
        moved[k] = first + second + third
    for k in range(3):
        # b . (dw x n) = dw . (n x b), and b_1, b_2, n are right-handed.
        x, y, z = sigma[21 + k], sigma[27 + k], sigma[33 + k]
        slope[2 * k] = x * basis[3] + y * basis[4] + z * basis[5]
        slope[2 * k + 1] = x * basis[0] + y * basis[1] + z * basis[2]
    out[0] = basis[3] * slope[0] + basis[4] * slope[2] + basis[5] * slope[4]
    out[1] = out[3] = -(basis[3] * slope[1] + basis[4] * slope[3] + basis[5] * slope[5])
    out[2] = out[6] = basis[3] * moved[3] + basis[4] * moved[4] + basis[5] * moved[5]
    out[4] = basis[0] * slope[1] + basis[1] * slope[3] + basis[2] * slope[5]
    out[5] = out[7] = -(basis[0] * moved[3] + basis[1] * moved[4] + basis[2] * moved[5])
    total = 0.0
    for k in range(3):
        total += normal[k] * moved[k] + turn[k] * moved[3 + k]
    out[8] = total


def fuse(plane: Any, rise: float, other: Any, common: float) -> cython.double:
    """Fuse two estimates of a plane (Eq. 37 to Eq. 45); Eq. 22 does so for offsets of scans.

    Eq. 39 is the error of the prior about the measured plane, e = (n_prior [-] n, d_prior), its
    covariances (Eq. 38) carried there. With A and R the covariances of prior and measurement
    (Eq. 40): K = A (A + R)^-1 (Eq. 41), fused = measured [+] (I - K) e (Eq. 43, Eq. 44), and each
    part of the covariance becomes (I - K) P (I - K)^T + K R K^T (Eq. 42, Eq. 45). All of it is
    about the prior's pivot, where a change of the slope does not change the well-known height.

    Common pose error neither weights the estimates nor averages out: only the share 1 - common of
    the pose parts P and Q counts in A and R, and the fused pose part is
    common ((1 - k) P + k Q) + (1 - common) ((I - K) P (I - K)^T + K Q K^T), k = K_dd.

    ``plane``: the prior, replaced by the fused plane; ``rise``: height of its origin above that of
    the measured plane, ``other``, m. Return the height of the fused plane above the measured one,
    m; the covariances are about it.
    """
    basis = cython.declare(cython.double[6])
    pivot = cython.declare(cython.double[3])
    change = cython.declare(cython.double[4])
    error = cython.declare(cython.double[3])
    prior = cython.declare(cython.double[18])
    measured = cython.declare(cython.double[18])
    one = cython.declare(cython.double[9])
    spread = cython.declare(cython.double[9])
    inverse = cython.declare(cython.double[9])
    gain = cython.declare(cython.double[9])
    rest = cython.declare(cython.double[9])
    kept = cython.declare(cython.double[18])
    taken = cython.declare(cython.double[18])
    cython.declare(i=cython.int, k=cython.int)
    basis_at(plane.normal, basis)
    _pivot(plane.range_part, rise, basis, error, pivot)
    interleave(plane.range_part, plane.pose_part, prior)
    shift_origin(prior, error[0], error[1], 2)
    error[0] = error[1] = 0.0
    normal = other.normal
    if plane.normal[0] != normal[0] or plane.normal[1] != normal[1]:
        minus_at(plane.normal, normal, error, change)
        turn_tangent(prior, change, 2)
        basis_at(normal, basis)
    first = basis[0] * pivot[0] + basis[1] * pivot[1] + basis[2] * pivot[2]
    second = basis[3] * pivot[0] + basis[4] * pivot[1] + basis[5] * pivot[2]
    interleave(other.range_part, other.pose_part, measured)
    shift_origin(measured, first, second, 2)
    error[2] = normal[0] * pivot[0] + normal[1] * pivot[1] + normal[2] * pivot[2]
    for i in range(9):
        one[i] = prior[2 * i] + (1.0 - common) * prior[2 * i + 1]
        spread[i] = one[i] + (measured[2 * i] + (1.0 - common) * measured[2 * i + 1])
    inverse_symmetric(spread, inverse)
    for i in range(3):
        for k in range(3):
            gain[3 * i + k] = (
                one[3 * i] * inverse[k]
                + one[3 * i + 1] * inverse[3 + k]
                + one[3 * i + 2] * inverse[6 + k]
            )
    for i in range(9):
        rest[i] = (1.0 if i % 4 == 0 else 0.0) - gain[i]
    congruent(rest, prior, kept)
    congruent(gain, measured, taken)
    share = min(max(gain[8], 0.0), 1.0)
    for i in range(9):
        own = (1.0 - common) * (kept[2 * i + 1] + taken[2 * i + 1])
        both = (1.0 - share) * prior[2 * i + 1] + share * measured[2 * i + 1]
        prior[2 * i] = kept[2 * i] + taken[2 * i]
        prior[2 * i + 1] = own + common * both
    for i in range(3):
        spread[i] = rest[3 * i] * error[0] + rest[3 * i + 1] * error[1] + rest[3 * i + 2] * error[2]
        plane.normal[i] = normal[i]
    spread[2] -= error[2]
    return _from_pivot(prior, pivot, spread, basis, plane)


def fuse_height(
    plane: Any,
    rise: float,
    lever: Vector,
    variance: float,
    other_pose: Vector,
    common: float,
    sloped: cython.bint,
) -> cython.double:
    """Fuse a plane with a height that was measured at one point, without a slope (see `fuse`).

    With l the lever from the pivot to the point, the error of the height there is h.e, h = (-l, 1).
    For a measurement with variance v from range noise and q from pose error, Eq. 40 is scalar:
    K = k h^T, k = A h / (h.A h + v + (1 - common) q), and
    (I - K) P (I - K)^T = P - k (P h)^T - (P h) k^T + (h.P h) k k^T.

    ``rise`` is the height of the plane's origin above that of the parallel plane through the point,
    m; ``lever`` (2) leads from the latter to the point, along the tangent axes, m; ``variance`` is
    v, m^2, and ``other_pose`` (9), overwritten, the pose part of the parallel plane. The slope
    changes only if ``sloped``; the covariances hold for any K. The fused plane replaces ``plane``,
    as in `fuse`; return its height above the parallel plane, m.
    """
    basis = cython.declare(cython.double[6])
    pivot = cython.declare(cython.double[3])
    step = cython.declare(cython.double[3])
    noise = cython.declare(cython.double[2])
    own = cython.declare(cython.double[2])
    across = cython.declare(cython.double[6])
    gain = cython.declare(cython.double[3])
    prior = cython.declare(cython.double[18])
    cython.declare(i=cython.int, j=cython.int, k=cython.int)
    basis_at(plane.normal, basis)
    _pivot(plane.range_part, rise, basis, step, pivot)
    interleave(plane.range_part, plane.pose_part, prior)
    shift_origin(prior, step[0], step[1], 2)
    first, second = step[0] + rise * basis[2], step[1] + rise * basis[5]
    shift_origin(other_pose, first, second, 1)
    x, y = first - lever[0], second - lever[1]
    for i in range(3):
        for k in range(2):
            j = 6 * i + k
            across[2 * i + k] = x * prior[j] + y * prior[j + 2] + prior[j + 4]
    for k in range(2):
        own[k] = x * across[k] + y * across[2 + k] + across[4 + k]
    noise[0], noise[1] = variance, offset_variance(other_pose, -x, -y)
    apart = 1.0 - common
    share = 1.0 / (own[0] + noise[0] + apart * (own[1] + noise[1]))
    for i in range(3):
        gain[i] = share * (across[2 * i] + apart * across[2 * i + 1])
    if not sloped:
        gain[0] = gain[1] = 0.0
    share = common * min(max(gain[2], 0.0), 1.0)
    for k in range(2):
        own[k] += noise[k]
    for i in range(3):
        for j in range(i + 1):
            k = 2 * (3 * i + j)
            x = prior[k] - gain[i] * across[2 * j] - gain[j] * across[2 * i]
            y = prior[k + 1] - gain[i] * across[2 * j + 1] - gain[j] * across[2 * i + 1]
            y = apart * (y + gain[i] * gain[j] * own[1]) + (common - share) * prior[k + 1]
            prior[k] = x + gain[i] * gain[j] * own[0]
            prior[k + 1] = y + share * other_pose[3 * i + j]
    for k in range(2):
        prior[2 + k], prior[4 + k], prior[10 + k] = prior[6 + k], prior[12 + k], prior[14 + k]
    for i in range(3):
        step[i] = -gain[i] * plane.normal[2] * rise
    return _from_pivot(prior, pivot, step, basis, plane)


def _pivot(c: Vector, rise: float, basis: Vector, arm: Vector, out: Vector) -> None:
    """Find the pivot (3), where the errors of a plane's slope and height are independent, m.

    ``c``: covariance (9) about the plane's origin, which is ``rise`` above that of the pivot, m.
    ``arm``: set to the pivot from the plane's origin along the tangent axes (2), m.
    """
    square = c[0] * c[4]
    share = square - c[1] * c[1]
    share = 1.0 / share if share > 1e-9 * square else 0.0
    x = share * (c[4] * c[2] - c[1] * c[5])
    y = share * (c[0] * c[5] - c[1] * c[2])
    arm[0], arm[1] = x, y
    out[0] = x * basis[0] + y * basis[3]
    out[1] = x * basis[1] + y * basis[4]
    out[2] = x * basis[2] + y * basis[5] + rise


def _from_pivot(
    pair: Vector, pivot: Vector, step: Vector, basis: Vector, out: Any
) -> cython.double:
    """Apply a step (3) of (dphi, dd) about the pivot (3) to a plane, and move its covariances.

    ``out.normal`` and ``basis`` become those after the step, and ``out`` receives the covariances
    of the ``pair`` about the new height over the origin, m, which is returned. Pair and pivot are
    overwritten.
    """
    cython.declare(i=cython.int)
    normal, range_part, pose_part = out.normal, out.range_part, out.pose_part
    plus_at(normal, basis, step, normal)
    orient_up(normal)
    basis_at(normal, basis)
    rise = step[2] + normal[0] * pivot[0] + normal[1] * pivot[1] + normal[2] * pivot[2]
    rise /= normal[2]
    pivot[2] -= rise
    first = -(basis[0] * pivot[0] + basis[1] * pivot[1] + basis[2] * pivot[2])
    second = -(basis[3] * pivot[0] + basis[4] * pivot[1] + basis[5] * pivot[2])
    shift_origin(pair, first, second, 2)
    for i in range(9):
        range_part[i] = pair[2 * i]
        pose_part[i] = pair[2 * i + 1]
    # Round-off shows in covariances far from the pivot, and below a lidar of exact position.
    remote: cython.bint = first * first + second * second > FAR_SQUARED
    for i in range(3):
        if remote or range_part[4 * i] < MIN_VARIANCE:
            uncorrelate(range_part, i, max(range_part[4 * i], MIN_VARIANCE))
        if remote or pose_part[4 * i] < MIN_VARIANCE:
            uncorrelate(pose_part, i, max(pose_part[4 * i], 0.0))
    return rise
