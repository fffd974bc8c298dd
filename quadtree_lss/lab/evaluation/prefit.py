# SPDX-License-Identifier: Apache-2.0
"""Consistency of the map: a scan's residuals before the scan is mapped (Eq. 46, 61-63)."""

from __future__ import annotations

from dataclasses import astuple, dataclass
from typing import NamedTuple

import cython
import numpy as np
from scipy.special import gammaincinv

from quadtree_lss.onboard.arrays import Array, Index
from quadtree_lss.onboard.config.settings import LidarConfig
from quadtree_lss.onboard.core.geometry.morton import squeezed
from quadtree_lss.onboard.core.sensing.register import RegisteredScan
from quadtree_lss.onboard.core.tree.cell_map import CellMap

if cython.compiled:
    from cython.cimports.libc.math import fabs, sqrt
    from cython.cimports.quadtree_lss.onboard.core.geometry.sphere import basis_at
    from cython.cimports.quadtree_lss.onboard.core.mapping.division import mahalanobis_factor
    from cython.cimports.quadtree_lss.onboard.core.mapping.measure import (
        pose_variance,
        range_variance,
    )
else:
    from math import fabs, sqrt

    from quadtree_lss.onboard.core.geometry.sphere import basis_at
    from quadtree_lss.onboard.core.mapping.division import mahalanobis_factor
    from quadtree_lss.onboard.core.mapping.measure import pose_variance, range_variance

#: Share of residuals outside the acceptance interval (alpha), half of them on either side.
OUTSIDE = 0.05
#: Least variance, m^2.
FLOOR = cython.declare(cython.double, 1e-12)
#: |n.u| is taken to be at least this (grazing incidence).
MIN_COSINE = cython.declare(cython.double, 0.05)


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
    centre = np.column_stack([cells.x, cells.y, cells.z]) - scan.origin
    total = cells.covariance.reshape(-1, 9)
    out = np.empty((3, len(point)))
    noise = (lidar.range_noise, lidar.range_noise_per_metre, lidar.beam_divergence)
    residuals(
        scan.points[point], leaf, centre, cells.normal, total, scan.pose.covariance, *noise, out
    )
    return PrefitStatistics(point, leaf, *out)


@cython.boundscheck(False)
@cython.locals(points=cython.double[:, ::1], leaf=cython.Py_ssize_t[::1])
@cython.locals(centre=cython.double[:, ::1], normal=cython.double[:, ::1])
@cython.locals(covariance=cython.double[:, ::1], sigma=cython.double[:, ::1])
@cython.locals(out=cython.double[:, ::1])
def residuals(
    points: Array,
    leaf: Index,
    centre: Array,
    normal: Array,
    covariance: Array,
    sigma: Array,
    range_noise: float,
    per_metre: float,
    divergence: float,
    out: Array,
) -> None:
    """Residual, its deviation, m, and the paper's d_M of each point (N, 3) about the lidar, m: rows
    of ``out`` (3, N). ``leaf`` (N,) is which of the M leaves, of ``centre`` about the lidar and
    ``normal`` (M, 3), ``covariance`` (M, 9) of (dphi, dd), each lies in; ``sigma`` (6, 6) is the
    pose's, the noise as of `lidar.range_variance`."""
    basis = cython.declare(cython.double[6])
    n = cython.declare(cython.double[3])
    r = cython.declare(cython.double[3])
    a = cython.declare(cython.double[3])
    cython.declare(i=cython.Py_ssize_t, at=cython.Py_ssize_t, j=cython.int, k=cython.int)
    with cython.nogil:
        for i in range(points.shape[0]):
            at = leaf[i]
            e = 0.0
            for j in range(3):
                n[j] = normal[at, j]
                r[j] = points[i, j]
                e += n[j] * (r[j] - centre[at, j])
            basis_at(n, basis)
            a[0] = a[1] = 0.0
            a[2] = -1.0
            for j in range(3):
                a[0] += basis[j] * (r[j] - centre[at, j])
                a[1] += basis[3 + j] * (r[j] - centre[at, j])
            plane = 0.0
            for j in range(3):
                for k in range(3):
                    plane += a[j] * covariance[at, 3 * j + k] * a[k]
            distance = sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
            cosine = fabs(n[0] * r[0] + n[1] * r[1] + n[2] * r[2]) / distance
            cosine = max(cosine, MIN_COSINE)
            along = range_variance(range_noise, per_metre, divergence, distance, cosine)
            variance = plane + along * cosine * cosine + pose_variance(n, r, sigma)
            out[0, i] = e
            out[1, i] = sqrt(max(variance, FLOOR))
            out[2, i] = fabs(e) * mahalanobis_factor(r, cosine, sigma, along, plane)
