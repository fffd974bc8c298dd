# SPDX-License-Identifier: Apache-2.0
"""When a cell's plane does not describe its ground (paper IV.D): the two division criteria."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import FeaturesConfig, MappingConfig
from quadtree_lss.core.geometry import planes, sphere
from quadtree_lss.core.geometry.feature import boulder_height
from quadtree_lss.core.geometry.planes import Moments
from quadtree_lss.core.mapping.fitting import Fit
from quadtree_lss.core.sensing import lidar
from quadtree_lss.core.tree.leaves import Leaves

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: E[chi_1] = sqrt(2 / pi) and E[chi_3] = sqrt(2) Gamma(2) / Gamma(3/2) of Eq. 47.
MEAN_CHI_1 = float(np.sqrt(2.0 / np.pi))
MEAN_CHI_3 = float(2.0 * np.sqrt(2.0 / np.pi))
#: Mean and standard deviation of chi_1 and of chi_3.
CHI_1 = (MEAN_CHI_1, float(np.sqrt(1.0 - MEAN_CHI_1**2)))
CHI_3 = (MEAN_CHI_3, float(np.sqrt(3.0 - MEAN_CHI_3**2)))

#: Share of measurements that stray returns, let through by the outlier gate, make exceptions.
STRAY = 2e-4


def distances(normal: Array, through: Array, group: Index, points: Array) -> Array:
    """Orthogonal distances (N,) of points (3, N) to their group's plane (Eq. 19), m.

    Args:
        normal: (M, 3).
        through: (M, 3) a point of each plane, same origin as ``points``.
        group: (N,) plane of each point.
    """
    out: Array = normal[:, 0][group] * points[0]
    out += normal[:, 1][group] * points[1]
    out += normal[:, 2][group] * points[2]
    out -= np.einsum("mi,mi->m", normal, through)[group]
    return out


@dataclass(frozen=True)
class GroupedPoints:
    """Points of a scan, in G groups of which M were fitted.

    Attributes:
        fitted: (M,) groups.
        group: (N,) group of each point, 0 .. G - 1.
        points: (3, N) m.
        count: (M,) points of the fitted groups.
        groups: G.
    """

    fitted: Index
    group: Index
    points: Array
    count: Array
    groups: int

    def mean_distance(self, normal: Array, through: Array) -> Array:
        """Mean orthogonal distance (M,) of the fitted groups' points to planes (M, 3) each, m."""
        if len(self.fitted) < self.groups:
            everywhere = np.zeros((2, self.groups, 3))
            everywhere[0, self.fitted], everywhere[1, self.fitted] = normal, through
            normal, through = everywhere[0], everywhere[1]
        away = distances(normal, through, self.group, self.points)
        total = np.bincount(self.group, np.abs(away, out=away), minlength=self.groups)
        out: Array = total[self.fitted] / self.count
        return out


def lack_of_fit(distance: Array, noise: Array, count: Array) -> Array:
    """Mean residual of a scan about its own fit over range noise, with sqrt(N / (N - 3)).

    Args:
        distance: (M,) mean |n.r - d|, m.
        noise: (M,) its standard deviation from range noise, m.
        count: (M,) points N; the plane took three degrees of freedom.

    Returns:
        (M,), of expectation E[chi_1] on planar ground; 0 where N <= 3.
    """
    free = np.maximum(count - 3.0, 1.0)
    out: Array = np.where(count > 3.0, distance / noise * np.sqrt(count / free), 0.0)
    return out


def mahalanobis_factor(
    normal: Array, ray: Array, point_covariance: Array, plane_variance: Array
) -> Array:
    """d_M / |epsilon| (M,) of Eq. 46 for residuals along the ray, 1/m.

    The predicted point lies on the measured point's ray, so r_hat - r_bar = epsilon u / (n.u) and
    d_M = |epsilon| sqrt(u^T Sigma^-1 u) / |n.u| with Eq. 61's
    Sigma = Sigma_r + s u u^T, s = (a^T Sigma_P a) / (n.u)^2. What is added along the ray adds to
    the variance there, 1 / (u^T Sigma^-1 u) = 1 / (u^T Sigma_r^-1 u) + s, so only Sigma_r is
    inverted, kept regular by a billionth of its trace.

    Args:
        normal, ray: (M, 3).
        point_covariance: (M, 3, 3) Sigma_r, m^2.
        plane_variance: (M,) a^T Sigma_P a, m^2; zero for a fit's own points.
    """
    cosine = np.maximum(np.abs(np.einsum("mi,mi->m", normal, ray)), planes.MIN_COSINE)
    trace = np.einsum("mii->m", point_covariance)
    regular = point_covariance + (1e-9 * trace + 1e-15)[:, None, None] * np.eye(3)
    weight = np.einsum("mi,mij,mj->m", ray, planes.inverse_symmetric(regular), ray)
    along = 1.0 / np.maximum(weight, 1e-300) + plane_variance / cosine**2
    out: Array = 1.0 / (np.sqrt(along) * cosine)
    return out


def lack_of_fit_statistic(fit: Fit, moment: Moments, seen: GroupedPoints) -> Array:
    """Division statistic (M,) of fitted cells by their own fit's residuals.

    Args:
        fit, moment: M cells.
        seen: Their points, about the origin of ``moment``.
    """
    distance = seen.mean_distance(fit.planes.normal, moment.mean)
    return lack_of_fit(distance, fit.noise, moment.count)


def mahalanobis_statistic(
    leaves: Leaves,
    rows: Index,
    fit: Fit,
    moment: Moments,
    seen: GroupedPoints,
    origin: Array,
    pose: lidar.Pose,
    range_noise: float,
) -> Array:
    """Division statistic (M,) of fitted cells by the paper's mean d_M of prefit residuals.

    A cell that had a measured plane before the scan is judged by that plane, a new one by its fit
    ("the fit quality between measurements and the initial estimate").

    Args:
        leaves: Before the fit is taken over.
        rows: (M,) leaves of the cells.
        seen: Their points, about the origin of ``moment``.
        origin: (3,) of ``points`` and ``moment`` in the map frame, m.
    """
    known = leaves.measured[rows]
    normal = np.where(known[:, None], leaves.normal[rows], fit.planes.normal)
    stored = np.column_stack([leaves.x[rows], leaves.y[rows], leaves.z[rows]]) - origin
    through = np.where(known[:, None], stored, moment.mean)
    distance = seen.mean_distance(normal, through)
    arm = moment.mean - stored
    basis = sphere.tangent_basis(normal)
    row = np.concatenate([-np.einsum("mij,mi->mj", basis, arm), np.ones((len(rows), 1))], axis=1)
    total = leaves.range_part[rows] + leaves.pose_part[rows]
    variance = np.where(known, np.einsum("mi,mij,mj->m", row, total, row), 0.0)
    sigma = lidar.point_covariances(moment.mean + origin, pose, range_noise)
    return distance * mahalanobis_factor(normal, moment.ray, sigma, np.nan_to_num(variance))


def asks(
    leaves: Leaves,
    rows: Index,
    statistic: Array,
    count: Array,
    mean_square: Array,
    config: MappingConfig,
) -> Mask:
    """Update the running mean of the division statistic; which leaves (M,) ask to be divided.

    The mean is over all processed measurements (Eq. 47). A scan counts by the residuals that its
    fit left free, N - 3: near the edge of a scan cells get four or five points at a time, and the
    single free residual of many such scans would outvote one full view. A mean of n residuals
    scatters by its chi distribution's deviation over sqrt(n); it must exceed the threshold by
    ``division_confidence`` of these, or cells with few points would divide by chance.

    Args:
        rows: (M,) leaves.
        statistic, count: (M,) this scan's statistic and points.
        mean_square: (M,) mean square residual about the fit, m^2.
    """
    weight = np.maximum(count - 3.0, 0.0)
    leaves.division_sum[rows] += weight * statistic
    leaves.division_weight[rows] += weight
    leaves.misfit[rows] = mean_square
    total = leaves.division_weight[rows]
    expected, spread = CHI_1 if config.division == "lack_of_fit" else CHI_3
    mean = leaves.division_sum[rows] / np.maximum(total, 1.0)
    doubt = config.division_confidence * spread / np.sqrt(np.maximum(total, 1.0))
    poor = mean > config.division_factor * expected + doubt
    poor &= total >= config.division_min_residuals
    return poor & (leaves.level[rows] < leaves.domain.max_level)


def rock_height(features: FeaturesConfig, range_noise: float) -> float:
    """Rocks from this height on divide leaves, m; lower ones are lost in the range noise."""
    return max(features.divide_height, 3.0 * range_noise)


def hides_rock(
    leaves: Leaves,
    rows: Index,
    mapping: MappingConfig,
    features: FeaturesConfig,
    range_noise: float,
) -> Mask:
    """Leaves (M,) above the finest level that hold a rock, which the mean over a large leaf hides.

    A rock of twenty points among ten thousand does not move Eq. 47's mean. It shows in one of
    three ways: by its exceptions (Eq. 48), if beyond what noise makes of them they amount to
    ``mapping.divide_exceptions`` measurements and to more than stray returns leave; by raised
    measurements, lower than these, over ``mapping.divide_area`` of the leaf; or as a feature of
    `rock_height` and narrow as a rock is. A leaf has one feature, so a rock beside another, or
    one that lies across the border of leaves, shows by its raised measurements alone.
    """
    counted = leaves.residuals[rows]
    noise = leaves.exception_noise[rows]
    least = np.maximum(mapping.divide_exceptions, STRAY * counted)
    rocky: Mask = leaves.exception_sum[rows] >= noise + np.maximum(least, 3.0 * np.sqrt(noise))
    rocky &= mapping.divide_exceptions > 0.0
    if mapping.divide_area > 0.0:
        noise = leaves.raised_noise[rows]
        share = mapping.divide_area / leaves.domain.cell_size(leaves.level[rows]) ** 2
        least = np.maximum(1.0, np.maximum(share, STRAY) * counted)
        rocky |= leaves.raised_sum[rows] >= noise + np.maximum(least, 3.0 * np.sqrt(noise))
    state = leaves.feature[rows]
    height = rock_height(features, range_noise)
    with np.errstate(invalid="ignore"):
        rocky |= (boulder_height(state) >= height) & (state[:, 4] <= features.divide_sigma)
    return rocky & (leaves.level[rows] < leaves.domain.max_level)
