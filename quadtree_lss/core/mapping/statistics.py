# SPDX-License-Identifier: Apache-2.0
"""Recursive statistics of leaves: roughness (Eq. 55), exceptions (Eq. 48), range-noise check."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from quadtree_lss.config.settings import MappingConfig
from quadtree_lss.core.geometry import planes, sphere
from quadtree_lss.core.geometry.planes import Moments
from quadtree_lss.core.mapping.division import MEAN_CHI_1, distances
from quadtree_lss.core.tree.leaves import Leaves

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: A point stands out of curved ground if it is this many root mean square residuals above.
OUTSTANDING = 4.0


@dataclass(frozen=True)
class Residuals:
    """A scan's residuals about the planes of the leaves it ended in.

    Attributes:
        rows: (M,) leaves, all measured.
        group: (N,) place of each point's leaf in ``rows``.
        distance: (N,) n.(r - mean): orthogonal distance without the scan's common offset in the
            cell, which pose error and not the ground explains, m.
        moment: Of the M leaves' points.
        points: (3, N) about ``origin``, m.
        origin: (3,) of ``points`` and ``moment`` in the map frame, m.
    """

    rows: Index
    group: Index
    distance: Array
    points: Array
    moment: Moments
    origin: Array


class FinalGroups:
    """Collects, round by round, the leaves in which a scan's points come to rest."""

    def __init__(self, points: int, origin: Array) -> None:
        self.origin = origin
        self._group = np.full(points, -1, dtype=np.intp)
        self._rows: list[Index] = []
        self._moments: list[Moments] = []
        self._count = 0

    def add(self, rows: Index, moment: Moments, moved: Mask, group: Index, index: Index) -> None:
        """Take the cells of a round that were not divided.

        Args:
            rows: (M,) leaves of the round.
            moment: Of their points.
            moved: (M,) True where the cell was divided and its points go on.
            group: (N,) place of each point's leaf.
            index: (N,) which of the scan's points.
        """
        stays = np.flatnonzero(~moved)
        place = np.full(len(rows), -1, dtype=np.intp)
        place[stays] = self._count + np.arange(len(stays))
        self._group[index] = place[group]
        self._rows.append(rows[stays])
        self._moments.append(moment.take(stays))
        self._count += len(stays)

    def residuals(self, leaves: Leaves, points: Array) -> Residuals:
        """Residuals of ``points`` (3, N) about ``origin``, of those in measured leaves."""
        rows = np.concatenate(self._rows)
        moment = planes.join(self._moments)
        measured = leaves.measured[rows]
        if measured.all():
            group = self._group
        else:
            place = np.cumsum(measured) - 1
            index = np.flatnonzero(measured[self._group])
            group = place[self._group[index]]
            points = points[:, index]
            rows, moment = rows[measured], moment.take(measured)
        distance = distances(leaves.normal[rows], moment.mean, group, points)
        return Residuals(rows, group, distance, points, moment, self.origin)


def accumulate(
    leaves: Leaves,
    residuals: Residuals,
    config: MappingConfig,
    range_noise: float,
    rock_height: float,
) -> None:
    """Add a scan to the sums of its leaves.

    Args:
        rock_height: Above the plane, m; see `raised`.

    Only leaves with two or more points in the scan are counted: the common offset takes one.
    """
    rows, group, count = residuals.rows, residuals.group, residuals.moment.count
    if not len(rows):
        return
    normal = leaves.normal[rows]
    variance = planes.orthogonal_noise_variance(normal, residuals.moment.ray, range_noise)
    distance = np.abs(residuals.distance)
    np.minimum(distance, config.residual_clip, out=distance)
    shared = np.where(count > 1.0, 1.0 - 1.0 / count, 0.0)
    leaves.distance_sum[rows] += np.bincount(group, distance, minlength=len(rows))
    leaves.noise_sum[rows] += count * MEAN_CHI_1 * np.sqrt(variance * shared)
    leaves.exception_sum[rows] += exception_mass(
        leaves, residuals, variance * shared, config.roughness_tolerance
    )
    # xi of a residual that is noise itself: the noise counts twice.
    beyond = config.roughness_tolerance / np.sqrt(2.0 * np.maximum(variance, 1e-12))
    leaves.exception_noise[rows] += np.where(count > 1.0, 2.0 * count * ndtr(-beyond), 0.0)
    leaves.raised_sum[rows] += raised(leaves, residuals, rock_height)
    beyond = rock_height / np.sqrt(np.maximum(variance, 1e-12))
    leaves.raised_noise[rows] += count * ndtr(-beyond)
    leaves.residuals[rows] += np.where(count > 1.0, count, 0.0)


def exception_mass(leaves: Leaves, residuals: Residuals, noise: Array, tolerance: float) -> Array:
    """Eq. 48's sum of xi in each leaf (M,): probability mass beyond the roughness tolerance.

    xi = Phi((e - t) / s) + Phi((-e - t) / s) with e the residual without the scan's offset and
    s^2 = noise + tilt variance at the point. Points whose |e| is three s or more inside the
    tolerance (s at the cell's corner) count as zero: their mass is below 0.00135.

    Args:
        noise: (M,) variance from range noise, m^2.
        tolerance: t, m.
    """
    rows, moment = residuals.rows, residuals.moment
    tilt = leaves.range_part[rows, :2, :2]
    reach = 0.5 * leaves.domain.cell_size(leaves.level[rows]) ** 2
    bound = np.sqrt(noise + reach * (tilt[:, 0, 0] + tilt[:, 1, 1]))
    out = np.zeros(len(rows))
    size = np.abs(residuals.distance)
    sure = tolerance - 3.0 * bound
    if size.max() <= sure.min():
        return out
    near = np.flatnonzero(size > sure[residuals.group])
    if not len(near):
        return out
    group = residuals.group[near]
    e = size[near]
    arm = residuals.points.take(near, axis=1) - moment.mean.T.take(group, axis=1)
    basis = sphere.tangent_basis(leaves.normal[rows])
    lever = np.einsum("kmj,km->jm", basis.transpose(1, 0, 2)[:, group], arm)
    at_point = noise[group] + tilt[group, 0, 0] * lever[0] ** 2 + tilt[group, 1, 1] * lever[1] ** 2
    at_point += 2.0 * tilt[group, 0, 1] * lever[0] * lever[1]
    deviation = np.sqrt(np.maximum(at_point, 1e-12))
    mass = ndtr((e - tolerance) / deviation) + ndtr((-e - tolerance) / deviation)
    out += np.bincount(group, mass, minlength=len(rows))
    return np.minimum(out, moment.count)


def raised(leaves: Leaves, residuals: Residuals, height: float) -> Array:
    """Measurements of each leaf (M,) more than ``height`` m above its plane that stand out.

    Standing out is to be farther above than `OUTSTANDING` times the root mean square residual: on
    curved ground many points are high, a rock's are few among low ones.
    """
    group = residuals.group
    high = np.flatnonzero(residuals.distance > height)
    usual = np.sqrt(leaves.misfit[residuals.rows])
    out = high[residuals.distance[high] > OUTSTANDING * usual[group[high]]]
    return np.bincount(group[out], minlength=len(residuals.rows)).astype(np.float64)


def densities(leaves: Leaves, rows: Index) -> tuple[Array, Array]:
    """Roughness density (Eq. 55, m^3) and exception fraction (Eq. 48) of leaves ``rows``.

    The noise floor is taken off the mean distance first: on flat ground it is all there is, and
    times the area of a large cell it would look rough. NaN for leaves without a measured plane;
    a measured one whose scans left one point each has 0.
    """
    counted = leaves.residuals[rows]
    safe = np.maximum(counted, 1.0)
    mean = np.maximum(leaves.distance_sum[rows] - leaves.noise_sum[rows], 0.0) / safe
    area = leaves.domain.cell_size(leaves.level[rows]) ** 2
    measured = leaves.measured[rows]
    roughness = np.where(measured, area * mean, np.nan)
    return roughness, np.where(measured, leaves.exception_sum[rows] / safe, np.nan)


class NoiseCheck:
    """Self-check: observed over configured range noise.

    Each scan gives the median over its points of the residual's standard deviation about the own
    fit of the cell they lie in, over what the configured range noise makes of it. On planar ground
    that is one; rough ground raises some cells, not the median while most of the ground is smooth
    at the size of a leaf.
    """

    MIN_POINTS = 8.0

    def __init__(self) -> None:
        self._ratio = np.nan

    @property
    def ratio(self) -> float:
        """Exponentially averaged ratio, NaN before the first scan."""
        return float(self._ratio)

    def add(self, leaves: Leaves, residuals: Residuals, range_noise: float) -> None:
        """Take one scan's residuals; ``leaves.misfit`` holds their mean square about the fits."""
        many = residuals.moment.count >= self.MIN_POINTS
        rows, weight = residuals.rows[many], residuals.moment.count[many]
        if len(rows) < 3:
            return
        variance = planes.orthogonal_noise_variance(
            leaves.normal[rows], residuals.moment.ray[many], range_noise
        )
        ratio = np.sqrt(leaves.misfit[rows] / variance)
        order = np.argsort(ratio)
        half = np.searchsorted(np.cumsum(weight[order]), 0.5 * np.sum(weight))
        median = float(ratio[order[half]])
        self._ratio = median if np.isnan(self._ratio) else 0.9 * self._ratio + 0.1 * median
