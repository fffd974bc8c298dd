# SPDX-License-Identifier: Apache-2.0
"""Consistency of the map: a scan's residuals before the scan is mapped (Eq. 46, 61-63)."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi

from quadtree_lss.onboard.arrays import Array, Index
from quadtree_lss.onboard.config.settings import LidarConfig
from quadtree_lss.onboard.core.geometry.morton import squeezed
from quadtree_lss.onboard.core.geometry.rotations import skew
from quadtree_lss.onboard.core.sensing.register import RegisteredScan
from quadtree_lss.onboard.core.tree.cell_map import CellMap

#: Share of residuals inside the acceptance interval (1 - alpha), half of the others on either side.
INSIDE = 0.95
#: Least variance, m^2.
FLOOR = 1e-12
#: |n.u| is taken to be at least this (grazing incidence).
MIN_COSINE = 0.05


def acceptance_interval(degrees: int) -> tuple[float, float]:
    """Eq. 62 and Eq. 63: bounds that hold 95 % of the chi distribution of ``degrees``."""
    low, high = chi(degrees).interval(INSIDE)
    return float(low), float(high)


class Fractions(NamedTuple):
    """Shares of residuals below and above the acceptance interval; NaN if there are none."""

    below: float
    above: float


@dataclass(frozen=True)
class Counts:
    """How many residuals lie outside the 95 % interval, which can be added up. ``points``:
    residuals. ``below``, ``above``: of the one-degree test. ``below_3``, ``above_3``: of the
    paper's three-degree test."""

    points: int = 0
    below: int = 0
    above: int = 0
    below_3: int = 0
    above_3: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

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


def prefit_statistics(cells: CellMap, scan: RegisteredScan, lidar: LidarConfig) -> PrefitStatistics:
    """Residuals of a scan about the map as it was published before the scan was mapped.

    The residual e = n.(r - c) - d has the variance n^T Sigma_r n + a^T Sigma_P a with Sigma_r of
    Eq. 17 (range and pose) and a = (B^T (r - c), -1). Measured and predicted point lie on one ray
    u, so Eq. 61's residual is e u / (n.u): it is one-dimensional and its d_M (Eq. 46) is a multiple
    of |e|. ``cells``: the map. ``scan``: points (N, 3) about the lidar with their finest cells.
    ``lidar``: of which the range noise matters.
    """
    column, row = squeezed(scan.key)
    of_point = cells.leaf_raster()[row, column]
    point = np.flatnonzero(cells.measured[of_point])
    leaf = of_point[point].astype(np.intp)
    n, r = cells.normal[leaf], scan.points[point]
    arm = r - (np.column_stack([cells.x, cells.y, cells.z]) - scan.origin)[leaf]
    residual = _dot(n, arm)
    # Both axes of the tangent plane (Eq. 2) along the arm.
    share = _dot(n[:, :2], arm[:, :2]) / (1.0 + n[:, 2]) + arm[:, 2]
    a = np.column_stack([arm[:, :2] - share[:, None] * n[:, :2], np.full(len(n), -1.0)])
    plane = np.einsum("ni,nij,nj->n", a, cells.covariance[leaf], a)
    distance = np.linalg.norm(r, axis=1)
    ray = r / distance[:, None]
    cosine = np.maximum(np.abs(_dot(n, ray)), MIN_COSINE)
    noise = lidar.range_noise + lidar.range_noise_per_metre * distance  # Eq. 13
    depth = lidar.beam_divergence * distance
    along = noise**2 + depth**2 * (1.0 / cosine**2 - 1.0)
    pose = _of_pose(r, scan.pose.covariance)
    variance = plane + along * cosine**2 + np.einsum("ni,nij,nj->n", n, pose, n)
    # What is added along the ray adds to the variance there: the pose's part alone is inverted,
    # kept regular by a millionth of its trace.
    trace = np.trace(pose, axis1=1, axis2=2)
    regular = pose + (1e-6 * trace + FLOOR)[:, None, None] * np.eye(3)
    weight = _dot(ray, np.linalg.solve(regular, ray[..., None])[..., 0])
    total = 1.0 / np.maximum(weight, 1e-300) + along + plane / cosine**2
    deviation = np.sqrt(np.maximum(variance, FLOOR))
    return PrefitStatistics(
        point, leaf, residual, deviation, np.abs(residual) / (cosine * np.sqrt(total))
    )


def _dot(one: Array, other: Array) -> Array:
    """Products (N,) of vectors (N, k)."""
    return np.asarray(np.einsum("ni,ni->n", one, other))


def _of_pose(arm: Array, covariance: Array) -> Array:
    """Pose part (N, 3, 3) of Eq. 17 for points (N, 3) about the lidar: J Sigma J^T with
    J = (I, -[r]_x) of the pose's covariance (6, 6)."""
    unit = np.broadcast_to(np.eye(3), (len(arm), 3, 3))
    jacobian = np.concatenate([unit, -skew(arm)], axis=-1)
    return np.asarray(jacobian @ covariance @ jacobian.transpose(0, 2, 1))
