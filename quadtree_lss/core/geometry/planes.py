# SPDX-License-Identifier: Apache-2.0
"""Planes: maximum-likelihood fit and its covariance (paper IV.A).

A plane is n.(r - c) = d (Eq. 18 about an origin c near the ground, which is a cell's centre here)
with its normal up (n_z > 0). Its error is e = (dphi_1, dphi_2, dd): dphi in the tangent plane at
n, axes of Eq. 2, rad; dd in m. Every function treats all planes at once: leading dimension M.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.geometry import sphere_arrays as sphere

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: |n.u| is taken to be at least this (grazing incidence).
MIN_COSINE = 0.05
#: A fit whose slope is less certain than this (rad, one sigma) is none.
MAX_SLOPE_SIGMA = 0.5
#: A map of elevations has no walls: steeper planes are tilted back to this n_z (87 deg).
MIN_UP = 0.05
#: Pose variances above this (m^2 or rad^2) say no more than this: nothing is known.
MAX_VARIANCE = 1e6
#: In-plane scatter thinner than this, relative to its length, is a line.
MIN_THICKNESS = 1e-4


@dataclass(frozen=True)
class Moments:
    """Sums over the points of each group, sufficient for a fit with equal weights in a group.

    Attributes:
        count: (G,) points.
        mean: (G, 3) centroid, m.
        scatter: (G, 3, 3) sum of (r - mean)(r - mean)^T, m^2.
        ray: (G, 3) unit direction from the lidar to the centroid.
    """

    count: Array
    mean: Array
    scatter: Array
    ray: Array

    def take(self, chosen: Index | Mask) -> Moments:
        """The chosen groups."""
        return Moments(
            self.count[chosen], self.mean[chosen], self.scatter[chosen], self.ray[chosen]
        )


def join(parts: Sequence[Moments]) -> Moments:
    """Moments of several sets of groups, one after the other."""
    return Moments(
        np.concatenate([part.count for part in parts]),
        np.concatenate([part.mean for part in parts]),
        np.concatenate([part.scatter for part in parts]),
        np.concatenate([part.ray for part in parts]),
    )


def moments(group: Index, groups: int, points: Array, lidar: Array) -> Moments:
    """Moments of points that are given as rows.

    Args:
        group: (N,) group of each point, 0 .. groups - 1; every group has a point.
        points: (3, N) about an origin near them (the sums are not centred first), m.
        lidar: (3,) or (G, 3) where each group was seen from, same origin, m.
    """
    count = np.bincount(group, minlength=groups).astype(np.float64)
    mean = np.empty((groups, 3))
    scatter = np.empty((groups, 3, 3))
    for i in range(3):
        mean[:, i] = np.bincount(group, points[i], minlength=groups) / count
    for i in range(3):
        for j in range(i, 3):
            total = np.bincount(group, points[i] * points[j], minlength=groups).astype(np.float64)
            total -= count * mean[:, i] * mean[:, j]
            scatter[:, i, j] = scatter[:, j, i] = np.maximum(total, 0.0) if i == j else total
    return Moments(count, mean, scatter, unit(mean - lidar))


def inverse_symmetric(matrices: Array) -> Array:
    """Inverse of symmetric positive definite (M, 3, 3) by cofactors of the scaled matrix.

    Scaled to a unit diagonal, a determinant below 1e-14 is round-off and taken as that: metres and
    radians of very different size do not spoil the inverse, and a singular matrix gives a large
    finite one.
    """
    diagonal = np.maximum(np.einsum("mii->mi", matrices), 1e-24)
    scale = 1.0 / np.sqrt(diagonal)
    scaled = matrices * (scale[:, :, None] * scale[:, None, :])
    b, c, e = (np.clip(scaled[:, i, j], -1.0, 1.0) for i, j in ((0, 1), (0, 2), (1, 2)))
    df, bf, be = 1.0 - e * e, c * e - b, b * e - c
    determinant = 1.0 / np.maximum(df + b * bf + c * be, 1e-14)
    out = np.empty_like(matrices)
    out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = df, bf, be
    out[:, 1, 1], out[:, 1, 2] = 1.0 - c * c, b * c - e
    out[:, 2, 2] = 1.0 - b * b
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = out[:, 0, 1], out[:, 0, 2], out[:, 1, 2]
    out *= scale[:, :, None] * scale[:, None, :] * determinant[:, None, None]
    return out


def horizontal_conditioning(scatter: Array) -> tuple[Array, Array]:
    """Least and greatest eigenvalue (M,), m^2, of the horizontal block of (M, 3, 3) scatters."""
    half = 0.5 * (scatter[:, 0, 0] + scatter[:, 1, 1])
    radius = np.hypot(0.5 * (scatter[:, 0, 0] - scatter[:, 1, 1]), scatter[:, 0, 1])
    return half - radius, half + radius


def fit_height(scatter: Array, prior_normal: Array, prior_spread: Array) -> Array:
    """Normals (M, 3) of the regression of height on (x, y) with a weak prior on the slope.

    z = z0 + a x + b y minimises sum (z - z0 - a x - b y)^2 + s |(a, b) - (a, b)_prior|^2, which is
    (S_xy + s I)(a, b) = S_xz + s (a, b)_prior with S the within-scan scatter.

    Args:
        scatter: (M, 3, 3), m^2.
        prior_normal: (M, 3) normal whose slope is the prior; finite also where unused.
        prior_spread: (M,) s, m^2: the horizontal scatter the prior stands for; 0 for none.
    """
    slope_x = -prior_normal[:, 0] / prior_normal[:, 2]
    slope_y = -prior_normal[:, 1] / prior_normal[:, 2]
    sxx, syy, sxy = (
        scatter[:, 0, 0] + prior_spread,
        scatter[:, 1, 1] + prior_spread,
        scatter[:, 0, 1],
    )
    sxz = scatter[:, 0, 2] + prior_spread * slope_x
    syz = scatter[:, 1, 2] + prior_spread * slope_y
    determinant = sxx * syy - sxy * sxy
    a = (syy * sxz - sxy * syz) / determinant
    b = (sxx * syz - sxy * sxz) / determinant
    return normal_from_slopes(a, b)


def normal_from_slopes(a: Array, b: Array) -> Array:
    """Upward unit normals (M, 3) of z = a x + b y, with n_z >= ``MIN_UP``."""
    up = 1.0 / np.sqrt(a * a + b * b + 1.0)
    normal = np.empty((len(up), 3))
    normal[:, 0], normal[:, 1], normal[:, 2] = -a * up, -b * up, up
    return normal if up.min(initial=1.0) >= MIN_UP else upward(normal)


def fit_orthogonal(scatter: Array, start: Array, iterations: int = 4) -> Array:
    """Normals (M, 3) of the paper's ML fit by Newton's method on the sphere.

    Eq. 23, Eq. 24 and Eq. 25 are the cost, Eq. 26, Eq. 27, Eq. 28, Eq. 29, Eq. 30 and Eq. 31 its
    linearisation, Eq. 32, Eq. 33, Eq. 34 and Eq. 35 the normal equations, Eq. 36 the step. With one
    free offset per scan and weights constant in a (cell, scan), the cost of Eq. 25 is n^T S n / 2,
    S the sum of within-scan scatters times their weights 1 / (n^T Sigma n), held at
    the current normal as in Eq. 35. With B the tangent basis at n: gradient B^T S n, Hessian
    B^T S B - (n^T S n) I. Where that is not positive definite the Gauss-Newton Hessian B^T S B
    of Eq. 33 serves.

    Args:
        scatter: (M, 3, 3) weighted within-scan scatter.
        start: (M, 3) first normals.
        iterations: Newton steps; convergence is cubic.
    """
    normal = start
    for _ in range(iterations):
        basis = sphere.tangent_basis(normal)
        image = (scatter @ normal[:, :, None])[:, :, 0]
        gradient = np.einsum("mij,mi->mj", basis, image)
        hessian = basis.transpose(0, 2, 1) @ scatter @ basis
        cost = np.einsum("mi,mi->m", normal, image)
        h00, h11, h01 = hessian[:, 0, 0] - cost, hessian[:, 1, 1] - cost, hessian[:, 0, 1]
        sound = (h00 > 0.0) & (h00 * h11 - h01 * h01 > 0.0)
        h00, h11 = np.where(sound, h00, h00 + cost), np.where(sound, h11, h11 + cost)
        determinant = np.maximum(h00 * h11 - h01 * h01, 1e-300)
        step = np.empty_like(gradient)
        step[:, 0] = -(h11 * gradient[:, 0] - h01 * gradient[:, 1]) / determinant
        step[:, 1] = -(h00 * gradient[:, 1] - h01 * gradient[:, 0]) / determinant
        length = np.hypot(step[:, 0], step[:, 1])
        step *= np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))[:, None]
        normal = upward(sphere.plus(normal, step))
    return normal


def upward(normals: Array) -> Array:
    """(n, d) and (-n, -d) are one plane: normals (M, 3) turned to n_z >= ``MIN_UP``."""
    up = np.where(normals[:, 2:] < 0.0, -normals, normals)
    low = np.flatnonzero(up[:, 2] < MIN_UP)
    if len(low):
        level = up[low, :2]
        level *= np.sqrt(1.0 - MIN_UP**2) / np.maximum(np.hypot(*level.T), 1e-300)[:, None]
        up[low, :2], up[low, 2] = level, MIN_UP
    return up


def orthogonal_noise_variance(normal: Array, ray: Array, range_noise: float) -> Array:
    """Variance (M,) of Eq. 19's residual from range noise: sigma^2 (n.u)^2, m^2."""
    cosine = np.abs(np.einsum("mi,mi->m", normal, ray))
    out: Array = (range_noise * np.maximum(cosine, MIN_COSINE)) ** 2
    return out


def slope_covariance(scatter: Array, basis: Array, spread: Array) -> Array:
    """Covariance (M, 2, 2) of dphi: (B^T S B + s I)^-1, the phi block of H^-1 (Eq. 35).

    Args:
        scatter: (M, 3, 3) within-scan scatter over the residual's variance.
        basis: (M, 3, 2) tangent basis.
        spread: (M,) what the slope prior adds, likewise over the variance.
    """
    h = basis.transpose(0, 2, 1) @ scatter @ basis
    h00, h11, h01 = h[:, 0, 0] + spread, h[:, 1, 1] + spread, h[:, 0, 1]
    determinant = h00 * h11 - h01 * h01
    out = np.empty((len(h), 2, 2))
    out[:, 0, 0], out[:, 1, 1] = h11 / determinant, h00 / determinant
    out[:, 0, 1] = out[:, 1, 0] = -h01 / determinant
    # A direction is never less certain than a radian.
    out *= np.minimum(1.0, 1.0 / (out[:, 0, 0] + out[:, 1, 1]))[:, None, None]
    return out


def covariance_about(slope: Array, offset_variance: Array, lever: Array) -> Array:
    """Covariance (M, 3, 3) of (dphi, dd) about an origin away from the centroid.

    The plane passes through the centroid: d = n.(centroid - origin), so with dphi and the
    centroid's offset dd_0 independent, dd = dd_0 + lever^T dphi.

    Args:
        slope: (M, 2, 2) covariance of dphi.
        offset_variance: (M,) variance of dd_0, m^2.
        lever: (M, 2) B^T (centroid - origin), m.
    """
    out = np.empty((len(slope), 3, 3))
    cross = (slope @ lever[:, :, None])[:, :, 0]
    out[:, :2, :2] = slope
    out[:, :2, 2] = out[:, 2, :2] = cross
    out[:, 2, 2] = offset_variance + np.einsum("mi,mi->m", lever, cross)
    return out


def pose_jacobian(normal: Array, basis: Array, arm: Array) -> Array:
    """How a scan's pose error moves its planes: (M, 3, 6) of (dphi, dd) by (dm, dw), map axes.

    A rigid motion turns n by dw x n and carries the plane's point at the origin along by
    dm + dw x arm, so dphi = B^T (dw x n) and dd = n.dm + (arm x n).dw.

    Args:
        normal: (M, 3).
        basis: (M, 3, 2) tangent basis.
        arm: (M, 3) plane's origin minus the lidar's position, m.
    """
    out = np.zeros((len(normal), 3, 6))
    # b . (dw x n) = dw . (n x b), and b_1, b_2, n are right-handed.
    out[:, 0, 3:] = basis[:, :, 1]
    np.negative(basis[:, :, 0], out=out[:, 1, 3:])
    out[:, 2, :3] = normal
    out[:, 2, 3:] = cross(arm, normal)
    return out


def unit(vectors: Array) -> Array:
    """Vectors (M, 3) over their length."""
    out: Array = vectors / np.sqrt(np.einsum("mi,mi->m", vectors, vectors))[:, None]
    return out


def cross(a: Array, b: Array) -> Array:
    """Cross products of (M, 3) by (M, 3)."""
    out = np.empty_like(a)
    out[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    out[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    out[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return out


def pose_part(normal: Array, basis: Array, arm: Array, root: Array) -> Array:
    """J Sigma_pose J^T, (M, 3, 3), of planes that one scan's pose error moves together.

    Args:
        root: (6, 6) or (M, 6, 6) with Sigma_pose = root root^T.
    """
    moved = pose_jacobian(normal, basis, arm) @ root
    return moved @ moved.transpose(0, 2, 1)


def covariance_root(covariance: Array) -> Array:
    """Matrix root of symmetric (..., K, K), eigenvalues kept to 0 .. ``MAX_VARIANCE``."""
    values, vectors = np.linalg.eigh(covariance)
    out: Array = vectors * np.sqrt(np.clip(values, 0.0, MAX_VARIANCE))[..., None, :]
    return out


def sum_by(group: Index, groups: int, values: Array) -> Array:
    """Sums of ``values`` (G, ...) over equal ``group`` (G,): (groups, ...)."""
    inner = values.shape[1:]
    flat = values.reshape(len(group), int(np.prod(inner)))
    out = np.empty((groups, flat.shape[1]))
    for k in range(flat.shape[1]):
        out[:, k] = np.bincount(group, flat[:, k], minlength=groups)
    return out.reshape(groups, *inner)
