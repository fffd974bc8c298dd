# SPDX-License-Identifier: Apache-2.0
"""Consistency of the map: a scan's residuals before the scan is mapped (Eq. 46, 61-63)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from quadtree_lss.core.geometry import planes, sphere
from quadtree_lss.core.sensing.lidar import point_covariances
from quadtree_lss.core.sensing.register import RegisteredScan, finest_of
from quadtree_lss.core.tree.leaves import Leaves

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: Share of residuals outside the acceptance interval (alpha), half of them on either side.
OUTSIDE = 0.05
#: Least variance, m^2.
_FLOOR = 1e-12
#: What is added to a pose part's axes, over their sum: some poses are certain in some direction.
_ROUND = 1e-6


def acceptance_interval(degrees: int) -> tuple[float, float]:
    """Eq. 62 and Eq. 63: bounds that hold 95 % of the chi distribution of ``degrees``."""
    low, high = 2.0 * gammaincinv(0.5 * degrees, [0.5 * OUTSIDE, 1.0 - 0.5 * OUTSIDE])
    return float(np.sqrt(low)), float(np.sqrt(high))


class Fractions(NamedTuple):
    """Shares of residuals below and above the acceptance interval; NaN if there are none."""

    below: float
    above: float


@dataclass(frozen=True)
class Counts:
    """How many residuals lie outside the 95 % interval, which can be added up.

    Attributes:
        points: Residuals.
        below, above: Of the one-degree test.
        below_3, above_3: Of the paper's three-degree test.
    """

    points: int = 0
    below: int = 0
    above: int = 0
    below_3: int = 0
    above_3: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(
            self.points + other.points,
            self.below + other.below,
            self.above + other.above,
            self.below_3 + other.below_3,
            self.above_3 + other.above_3,
        )

    @property
    def one_degree(self) -> Fractions:
        """Consistent if both are 0.025."""
        return self._fractions(self.below, self.above)

    @property
    def three_degrees(self) -> Fractions:
        """The paper's Table 2. The residual having one degree of freedom, most lie below."""
        return self._fractions(self.below_3, self.above_3)

    def _fractions(self, below: int, above: int) -> Fractions:
        n = self.points or float("nan")
        return Fractions(below / n, above / n)


@dataclass(frozen=True)
class PrefitStatistics:
    """Residuals of the points of a scan that lie in leaves with a measured plane.

    Attributes:
        point: (N,) which of the scan's points these are.
        row: (N,) their leaves.
        residual: (N,) n.(r - c) - d, m.
        deviation: (N,) its standard deviation, m.
        mahalanobis: (N,) the paper's d_M of the residual as a vector.
    """

    point: Index
    row: Index
    residual: Array
    deviation: Array
    mahalanobis: Array

    @property
    def normalised(self) -> Array:
        """(N,) |residual| / deviation, of chi_1 if map and noises are what they say."""
        out: Array = np.abs(self.residual) / self.deviation
        return out

    def counts(self) -> Counts:
        """How many lie outside the 95 % intervals."""
        low, high = acceptance_interval(1)
        low_3, high_3 = acceptance_interval(3)
        one, three = self.normalised, self.mahalanobis
        return Counts(
            len(one),
            int(np.count_nonzero(one < low)),
            int(np.count_nonzero(one > high)),
            int(np.count_nonzero(three < low_3)),
            int(np.count_nonzero(three > high_3)),
        )


def prefit_statistics(leaves: Leaves, scan: RegisteredScan, range_noise: float) -> PrefitStatistics:
    """Residuals of a scan about the leaves as they are; call it before the scan is mapped.

    The residual e = n.(r - c) - d has the variance n^T Sigma_r n + a^T Sigma_P a with Sigma_r of
    Eq. 17 (range and pose) and a = (B^T (r - c), -1). Measured and predicted point lie on one ray
    u, so Eq. 61's residual is e u / (n.u): it is one-dimensional and its d_M (Eq. 46) is a
    multiple of |e|.

    Args:
        leaves: Not changed.
        scan: Points with the finest cells under them.
        range_noise: Standard deviation of a range, m.
    """
    of_point = leaves.leaf_of_finest[finest_of(scan, leaves.domain)].astype(np.intp)
    point = np.flatnonzero(leaves.measured[of_point])
    row = of_point[point]
    points = scan.points[point] + scan.origin
    normal = leaves.normal[row]
    arm = points - np.column_stack([leaves.x[row], leaves.y[row], leaves.z[row]])
    residual = np.einsum("ni,ni->n", normal, arm)
    a = np.full((len(row), 3), -1.0)
    a[:, :2] = np.einsum("nij,ni->nj", sphere.tangent_basis(normal), arm)
    total = leaves.range_part[row] + leaves.pose_part[row]
    plane = np.einsum("ni,nij,nj->n", a, total, a)
    pose = point_covariances(points, scan.pose, 0.0)
    ray = planes.unit(points - scan.pose.position)
    cosine = np.einsum("ni,ni->n", normal, ray)
    variance = np.einsum("ni,nij,nj->n", normal, pose, normal) + plane
    variance += (range_noise * cosine) ** 2
    cosine = np.maximum(np.abs(cosine), planes.MIN_COSINE)
    along = _variance_along(ray, pose) + range_noise**2 + plane / cosine**2
    return PrefitStatistics(
        point,
        row,
        residual,
        np.sqrt(np.maximum(variance, _FLOOR)),
        np.abs(residual) / (cosine * np.sqrt(along)),
    )


def _variance_along(ray: Array, covariance: Array) -> Array:
    """1 / (u^T C^-1 u), m^2: (N,) of unit ``ray`` (N, 3) and ``covariance`` (N, 3, 3).

    What a covariance along the ray itself, C + s u u^T, makes larger by just s: so that range and
    plane can be added afterwards, however much they and the pose differ in size.
    """
    trace = np.einsum("nii->n", covariance)
    regular = covariance + (_ROUND * np.abs(trace) + _FLOOR)[:, None, None] * np.eye(3)
    weight = np.einsum("ni,nij,nj->n", ray, planes.inverse_symmetric(regular), ray)
    out: Array = 1.0 / np.maximum(weight, 1e-300)
    return out
