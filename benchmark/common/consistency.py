# SPDX-License-Identifier: Apache-2.0
"""Prefit residuals of a scan against the map's covariances (Table 2; Eq. 46, 61-63).

Eq. 61 compares a measured point with the intersection of its ray and the plane, so that the
residual has one degree of freedom. The test uses chi_1, where the paper uses chi_3.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from scipy.stats import chi

from quadtree_lss.onboard.arrays import Array, Index
from quadtree_lss.onboard.config.settings import LidarConfig
from quadtree_lss.onboard.core.geometry.morton import SPREAD
from quadtree_lss.onboard.core.geometry.rotations import skew
from quadtree_lss.onboard.core.sensing.register import RegisteredScan
from quadtree_lss.onboard.core.tree.cell_map import CellMap

#: Acceptance interval of |residual| / sigma (Eq. 62, Eq. 63): the central 95 % of chi_1.
LOW, HIGH = (float(bound) for bound in chi(1).interval(0.95))
#: Lower bound of a variance, m^2.
MIN_VARIANCE = 1e-12


@dataclass(frozen=True)
class Counts:
    """Number of residuals, and of those below and above the 95 % interval."""

    points: int = 0
    below: int = 0
    above: int = 0

    def __add__(self, other: Counts) -> Counts:
        return Counts(*map(int.__add__, astuple(self), astuple(other)))

    @property
    def shares(self) -> tuple[float, float]:
        """Shares below and above the interval: 0.025 each if consistent, NaN without residuals."""
        return self.below / (self.points or np.nan), self.above / (self.points or np.nan)


@dataclass(frozen=True)
class PrefitStatistics:
    """Residuals (N,) of the points of a scan in leaves with a measured plane: indices of points,
    rows of leaves, n.(r - c) - d and its standard deviation, m."""

    point: Index
    row: Index
    residual: Array
    sigma: Array

    def counts(self) -> Counts:
        normalised = np.abs(self.residual) / self.sigma
        below, above = int((normalised < LOW).sum()), int((normalised > HIGH).sum())
        return Counts(len(self.point), below, above)


def prefit_statistics(cells: CellMap, scan: RegisteredScan, lidar: LidarConfig) -> PrefitStatistics:
    """Compute the residuals of a scan to the map ``cells`` before that scan.

    e = n.(r - c) - d has the variance n^T Sigma_r n + a^T Sigma_P a with Sigma_r of Eq. 17 and
    a = (B^T (r - c), -1).
    """
    column, row = (np.searchsorted(SPREAD, code & 0x55555555) for code in (scan.key, scan.key >> 1))
    leaf_rows = cells.leaf_raster()[row, column]
    point = np.flatnonzero(cells.measured[leaf_rows])
    leaf = leaf_rows[point].astype(np.intp)
    n, r = cells.normal[leaf], scan.points[point]
    arm = r - (np.column_stack([cells.x, cells.y, cells.z]) - scan.pose.position)[leaf]
    residual = _dot(n, arm)
    share = _dot(n[:, :2], arm[:, :2]) / (1.0 + n[:, 2]) + arm[:, 2]
    a = np.column_stack([arm[:, :2] - share[:, None] * n[:, :2], np.full(len(n), -1.0)])
    plane = np.einsum("ni,nij,nj->n", a, cells.covariance[leaf], a)
    # Range noise acts along the ray (Eq. 13), the pose by J = (I, -[r]_x) (Eq. 17).
    cosine = _dot(n, r) / np.linalg.norm(r, axis=1)
    unit = np.broadcast_to(np.eye(3), (len(r), 3, 3))
    along = np.einsum("ni,nij->nj", n, np.concatenate([unit, -skew(r)], axis=-1))
    pose = np.einsum("ni,ij,nj->n", along, scan.pose.covariance, along)
    variance = plane + (lidar.range_noise * cosine) ** 2 + pose
    return PrefitStatistics(point, leaf, residual, np.sqrt(np.maximum(variance, MIN_VARIANCE)))


def _dot(one: Array, other: Array) -> Array:
    """Dot products (N,) of vectors (N, k)."""
    return np.asarray(np.einsum("ni,ni->n", one, other))
