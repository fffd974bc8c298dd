# SPDX-License-Identifier: Apache-2.0
"""Subscale features: one bell-shaped bump in a leaf, smaller than the leaf (paper V.C).

Heights are above the cell's plane, so that a slope is no bump; shape and state: see `core.bump`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import FeaturesConfig
from quadtree_lss.core.geometry import planes
from quadtree_lss.core.geometry.feature import boulder_height
from quadtree_lss.core.mapping.bump_fit import (
    Samples,
    estimate,
    first_states,
    flat_cost,
    gather_raised,
    lay_out,
    promise,
)
from quadtree_lss.core.mapping.statistics import Residuals
from quadtree_lss.core.tree.leaves import Leaves

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

#: Points this many standard deviations above the plane make a cell a candidate.
HIGH = 3.0
#: Fraction of points that noise alone raises so high, P(N(0, 1) > 3).
CHANCE = 0.00135
#: Half side of the square around a bump whose points are used, in sigma.
WINDOW = 5.0
#: A first estimate must lower the cost (a chi-square) by this much against flat ground.
SIGNIFICANCE = 25.0
#: Candidates treated in one scan; the rest wait for the next, the strongest go first.
MAX_CANDIDATES = 256


@dataclass(frozen=True)
class Candidates:
    """C leaves in which a scan shows a feature or may, and the N points in them.

    Attributes:
        rows: (C,) leaves.
        size: (C,) their sides, m.
        count: (C,) their points.
        variance: (C,) of a point's height above the plane, m^2.
        cell: (N,) leaf of each point, 0 .. C - 1.
        x, y: (N,) relative to the cell's centre, m.
        z: (N,) height above the cell's plane, m.
        high: (N,) True where the point stands out.
    """

    rows: Index
    size: Array
    count: Array
    variance: Array
    cell: Index
    x: Array
    y: Array
    z: Array
    high: Mask

    def start(self, fresh: Mask) -> Array:
        """Where first estimates begin, (F, 5), of the leaves marked ``fresh`` (C,), each of which
        has a point that stands out."""
        chosen = fresh.nonzero()[0]
        place = np.full(len(fresh), -1, dtype=np.intp)
        place[chosen] = np.arange(len(chosen))
        high = self.high.nonzero()[0]
        high = high[fresh[self.cell[high]]]
        cell = place[self.cell[high]]
        raised = gather_raised(cell, len(chosen), self.x[high], self.y[high], self.z[high])
        return first_states(raised, self.count[chosen], self.size[chosen] ** 2)

    def window(self, mean: Array) -> Samples:
        """Samples around each mean (C, 5): beyond a few sigma they say nothing of the bump."""
        cell = self.cell
        reach = np.minimum(np.maximum(WINDOW * mean[:, 4], 0.5), self.size)
        away = np.maximum(np.abs(self.x - mean[cell, 2]), np.abs(self.y - mean[cell, 3]))
        inside = (away <= reach[cell]).nonzero()[0]
        return lay_out(cell[inside], self.variance, self.x[inside], self.y[inside], self.z[inside])


class FeatureEstimator:
    """Keeps the feature columns of the leaves up to date, scan by scan."""

    def __init__(self, config: FeaturesConfig) -> None:
        self.config = config

    def update(self, leaves: Leaves, residuals: Residuals, range_noise: float) -> None:
        """Update the features of the leaves that a scan shows one in, or that had one.

        A leaf is a candidate if clearly more points stand out than noise raises on flat ground; a
        feature that later scans do not show fades away.
        """
        rows = residuals.rows
        if not self.config.enabled or not len(rows):
            return
        normal = leaves.normal[rows]
        variance = planes.orthogonal_noise_variance(normal, residuals.moment.ray, range_noise)
        gate = np.maximum(HIGH * np.sqrt(variance), 0.5 * self.config.min_height * normal[:, 2])
        high = residuals.distance > gate[residuals.group]
        count = residuals.moment.count
        raised = np.bincount(residuals.group[high], minlength=len(rows))
        chance = CHANCE * count
        known = np.isfinite(leaves.feature[rows, 1])
        candidate = raised >= np.maximum(2.0, chance + 2.0 * np.sqrt(chance))
        candidate |= known
        chosen = (candidate & (count >= self.config.min_points)).nonzero()[0]
        if not len(chosen):
            return
        if len(chosen) > MAX_CANDIDATES:
            strongest = np.argsort(-raised[chosen], kind="stable")[:MAX_CANDIDATES]
            chosen = np.sort(chosen[strongest])
        up = normal[chosen, 2]
        candidates = _candidates(leaves, residuals, chosen, high, up, variance[chosen])
        self._estimate(leaves, candidates, known[chosen])

    def _estimate(self, leaves: Leaves, candidates: Candidates, known: Mask) -> None:
        rows, size = candidates.rows, candidates.size
        mean = leaves.feature[rows]
        if not known.all():
            mean[~known] = candidates.start(~known)
        samples = candidates.window(mean)
        worth = (known | (promise(samples, mean) >= 0.5 * SIGNIFICANCE)).nonzero()[0]
        if not len(worth):
            return
        if len(worth) < len(rows):
            samples, mean = samples.take(worth), mean[worth]
            rows, size, known = rows[worth], size[worth], known[worth]
        # Eq. 52's unit covariance for a new feature, the last one for a known.
        information = np.broadcast_to(np.eye(5), (len(rows), 5, 5)).copy()
        information[known] = np.linalg.inv(leaves.feature_covariance[rows[known]])
        finest = 0.4 * size / np.sqrt(candidates.count[worth])
        state, covariance, cost = estimate(samples, mean, information, known, 0.5 * size, finest)
        config = self.config
        keep = (
            (state[:, 1] ** 2 >= config.min_volume)
            & (boulder_height(state) >= config.min_height)
            & (state[:, 4] <= config.max_sigma_fraction * size)
            & (known | (flat_cost(samples) - cost >= SIGNIFICANCE))
            & np.isfinite(covariance).all(axis=(1, 2))
        )
        leaves.feature[rows] = np.where(keep[:, None], state, np.nan)
        leaves.feature_covariance[rows] = np.where(keep[:, None, None], covariance, np.nan)


def _candidates(
    leaves: Leaves, residuals: Residuals, chosen: Index, high: Mask, up: Array, variance: Array
) -> Candidates:
    """The ``chosen`` (C,) of the residuals' leaves, with n_z and variance of n.r - d of each."""
    rows = residuals.rows[chosen]
    place = np.full(len(residuals.rows), -1, dtype=np.intp)
    place[chosen] = np.arange(len(chosen))
    cell = place[residuals.group]
    mine = (cell >= 0).nonzero()[0]
    cell = cell[mine]
    return Candidates(
        rows,
        leaves.domain.cell_size(leaves.level[rows]),
        residuals.moment.count[chosen],
        variance / up**2,
        cell,
        residuals.points[0, mine] + (residuals.origin[0] - leaves.x[rows])[cell],
        residuals.points[1, mine] + (residuals.origin[1] - leaves.y[rows])[cell],
        residuals.distance[mine] / up[cell],
        high[mine],
    )
