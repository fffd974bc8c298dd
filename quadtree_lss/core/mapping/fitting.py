# SPDX-License-Identifier: Apache-2.0
"""Planes of cells from the points of one scan, or from stored points of several (paper IV.A)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import MappingConfig
from quadtree_lss.core.geometry import planes, sphere
from quadtree_lss.core.geometry.fusion import Planes
from quadtree_lss.core.geometry.planes import Moments

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: A base narrower than this many horizontal noises may be an edge's making.
EDGE_SPREAD = 4.0
#: Half the standard deviation of points that fill a cell of side one, 1 / sqrt(12).
FULL_SPREAD = 0.5 / np.sqrt(12.0)


@dataclass(frozen=True)
class SlopePrior:
    """What the parent says of the slope of cells that have no measurement of their own.

    Attributes:
        normal: (M, 3) the parent's normal, any upward normal where unused.
        spread: (M,) horizontal scatter in m^2 that it is worth; 0 for none.
    """

    normal: Array
    spread: Array

    def take(self, chosen: Index | Mask) -> SlopePrior:
        """The chosen cells."""
        return SlopePrior(self.normal[chosen], self.spread[chosen])


@dataclass(frozen=True)
class Fit:
    """Fitted planes of M cells.

    Attributes:
        planes: d is zero about (x, y, z), the cell's centre at the plane's height.
        z: (M,) that height, m.
        noise: (M,) standard deviation of a residual n.r - d from range noise alone, m.
        basis: (M, 3, 2) tangent basis at the normal.
    """

    planes: Planes
    z: Array
    noise: Array
    basis: Array


def fittable(
    moment: Moments, size: Array, prior: SlopePrior, config: MappingConfig, range_noise: float
) -> Mask:
    """Which groups (M,) determine a plane: enough points on a base that is wide enough.

    Points are binned by their measured x and y. Over ground that fills the cell this does not bias
    the regression of height, whatever the horizontal noise; but where a scan's edge cuts a strip
    off the cell, the strip's width is noise that goes with the heights' noise and the plane would
    turn towards the ray. So the horizontal spread (standard deviation) along its thinnest axis
    must reach ``EDGE_SPREAD`` times the horizontal noise, or half of what a full cell has.

    Args:
        moment: M groups.
        size: (M,) side of the cells, m.
        prior: What is known of the slope.
    """
    least, greatest = planes.horizontal_conditioning(moment.scatter)
    across = range_noise * np.hypot(moment.ray[:, 0], moment.ray[:, 1])
    spread = np.minimum(EDGE_SPREAD * across, FULL_SPREAD * size)
    wide: Mask = least > moment.count * spread**2
    wide &= least > planes.MIN_THICKNESS * greatest
    wide &= least + prior.spread > (range_noise / planes.MAX_SLOPE_SIGMA) ** 2
    return wide & (moment.count >= config.min_points)


def fit_scan(
    moment: Moments,
    centre: Array,
    prior: SlopePrior,
    config: MappingConfig,
    range_noise: float,
    lidar: Array,
    pose_root: Array,
) -> Fit:
    """Planes of cells from one scan.

    Args:
        moment: M groups, map axes about an origin of the caller's.
        centre: (M, 2) cell centres about the same origin, m.
        prior: Slope prior.
        config: Fit method and covariance treatment.
        range_noise: Standard deviation of a range, m.
        lidar: (3,) lidar position about the same origin.
        pose_root: (6, 6) root of the pose covariance.
    """
    normal = _normals(moment.scatter, prior, config)
    basis = sphere.tangent_basis(normal)
    variance = planes.orthogonal_noise_variance(normal, moment.ray, range_noise)
    noise = np.sqrt(variance)
    if config.covariance == "independent":
        variance = variance + pose_variance(normal, moment.mean - lidar, pose_root)
    weight = 1.0 / variance
    slope = planes.slope_covariance(
        moment.scatter * weight[:, None, None], basis, prior.spread * weight
    )

    def pose_part(origin: Array) -> Array:
        if config.covariance == "independent":
            return np.zeros((len(normal), 3, 3))
        return planes.pose_part(normal, basis, origin - lidar, pose_root)

    offset = variance / moment.count
    return _about_centre(normal, basis, noise, slope, moment.mean, offset, centre, pose_part)


def pool_scans(
    moment: Moments, cell: Index, cells: int, min_points: int
) -> tuple[Moments, Array, Mask]:
    """What several scans say of each cell together.

    Args:
        moment: G groups, one for each (cell, scan) that occurs.
        cell: (G,) cell of each group, 0 .. M - 1, all of which occur.
        cells: M.
        min_points: Points of one scan, or points beyond one in each scan, that make a first fit.

    Returns:
        Moments of the M cells (scatters summed, means averaged over scans as in Eq. 22), the
        number of scans (M,), and which cells have enough points.
    """
    total = planes.sum_by(cell, cells, moment.count)
    scans = planes.sum_by(cell, cells, np.ones(len(cell)))
    most = np.zeros(cells)
    np.maximum.at(most, cell, moment.count)
    pooled = Moments(
        total,
        planes.sum_by(cell, cells, moment.mean) / scans[:, None],
        planes.sum_by(cell, cells, moment.scatter),
        planes.unit(planes.sum_by(cell, cells, moment.count[:, None] * moment.ray)),
    )
    return pooled, scans, (most >= min_points) | (total - scans >= min_points)


def fit_scans(
    moment: Moments,
    cell: Index,
    scan: Index,
    centre: Array,
    prior: SlopePrior,
    config: MappingConfig,
    range_noise: float,
    lidars: Array,
    pose_roots: Array,
) -> Fit:
    """Planes of cells from stored points of several scans, each with its own offset gamma_j
    (Eq. 20, Eq. 21).

    The normal follows from the sum of the within-scan scatters over their residuals' variances
    (which depend on the normal a little: two passes); gamma_j = n.mean_j, and d = mean of gamma_j
    (Eq. 22), so the range part of its variance is sum_j v_j / N_j / N_s^2 and the pose part
    sum_j Q_j / N_s^2, scans being independent.

    Args:
        moment: G groups, one for each (cell, scan) that occurs; the cells are ``fittable``.
        cell: (G,) cell of each group, 0 .. M - 1, all of which occur.
        scan: (G,) index into ``lidars`` and ``pose_roots``.
        centre: (M, 2) cell centres.
        prior: Slope prior of the M cells.
        lidars: (S, 3) lidar positions.
        pose_roots: (S, 6, 6) roots of pose covariances.
    """
    cells = len(centre)
    pooled, scans, _ = pool_scans(moment, cell, cells, config.min_points)
    normal = _normals(pooled.scatter, prior, config)
    for _ in range(2):
        variance = planes.orthogonal_noise_variance(normal[cell], moment.ray, range_noise)
        if config.covariance == "independent":
            arm = moment.mean - lidars[scan]
            variance = variance + pose_variance(normal[cell], arm, pose_roots[scan])
        weight = 1.0 / variance
        average = planes.sum_by(cell, cells, weight * moment.count) / pooled.count
        scatter = planes.sum_by(cell, cells, moment.scatter * weight[:, None, None])
        normal = _normals(scatter / average[:, None, None], prior, config)
    basis = sphere.tangent_basis(normal)
    mean_noise = np.sqrt(planes.orthogonal_noise_variance(normal, pooled.ray, range_noise))
    slope = planes.slope_covariance(scatter, basis, prior.spread * average)
    offset = planes.sum_by(cell, cells, variance / moment.count) / scans**2

    def pose_part(origin: Array) -> Array:
        if config.covariance == "independent":
            return np.zeros((cells, 3, 3))
        arm = origin[cell] - lidars[scan]
        part = planes.pose_part(normal[cell], basis[cell], arm, pose_roots[scan])
        return planes.sum_by(cell, cells, part) / (scans**2)[:, None, None]

    return _about_centre(normal, basis, mean_noise, slope, pooled.mean, offset, centre, pose_part)


def _normals(scatter: Array, prior: SlopePrior, config: MappingConfig) -> Array:
    normal = planes.fit_height(scatter, prior.normal, prior.spread)
    if config.fit == "ml":
        normal = planes.fit_orthogonal(scatter, normal)
    return normal


def _about_centre(
    normal: Array,
    basis: Array,
    noise: Array,
    slope: Array,
    mean: Array,
    offset_variance: Array,
    centre: Array,
    pose_part: Callable[[Array], Array],
) -> Fit:
    """Plane through ``mean`` with its covariance about the cell's centre at the plane's height."""
    to_mean = np.empty_like(mean)
    to_mean[:, :2] = mean[:, :2] - centre
    rise = np.einsum("mi,mi->m", normal[:, :2], to_mean[:, :2]) / normal[:, 2]
    z = mean[:, 2] + rise
    to_mean[:, 2] = -rise
    lever = np.einsum("mij,mi->mj", basis, to_mean)
    estimate = Planes.of(
        normal,
        np.zeros(len(normal)),
        planes.covariance_about(slope, offset_variance, lever),
        pose_part(np.column_stack([centre, z])),
    )
    return Fit(estimate, z, noise, basis)


def pose_variance(normal: Array, arm: Array, pose_root: Array) -> Array:
    """Variance (M,) that pose error gives n.r at a point ``arm`` (M, 3) from the lidar, m^2."""
    row = np.concatenate([normal, planes.cross(arm, normal)], axis=1)
    moved = (row[:, None, :] @ pose_root)[:, 0, :]
    out: Array = np.einsum("mi,mi->m", moved, moved)
    return np.minimum(out, planes.MAX_VARIANCE)
