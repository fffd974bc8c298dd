# SPDX-License-Identifier: Apache-2.0
"""Leaves with their plane estimates and running statistics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.geometry import fusion
from quadtree_lss.core.geometry.fusion import Planes
from quadtree_lss.core.tree.quadtree import CHILD_X, CHILD_Y, Domain, Quadtree

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


class Leaves(Quadtree):
    """The quadtree's leaves, each with a plane through (x, y, z) and what is counted on it.

    Attributes:
        z: Plane's elevation at the cell's centre, m; NaN without an estimate.
        normal: (., 3) upward unit normal.
        parts: (., 2, 3, 3) covariance of (dphi_1, dphi_2, dd), d about (x, y, z): of range noise
            and of pose error.
        measured: True where own points were fitted, False if empty or inherited.
        points_fitted: Measurements in the estimate.
        misfit: Mean square orthogonal residual of the last scan about its own fit, m^2.
        distance_sum: Sum of |orthogonal distance| (Eq. 55), m.
        noise_sum: What range noise alone adds to ``distance_sum``, m.
        exception_sum: Sum of exception masses (Eq. 48).
        exception_noise: What range noise alone adds to ``exception_sum``.
        raised_sum: Measurements that stand out above the plane (`statistics.raised`).
        raised_noise: What range noise alone adds to ``raised_sum``.
        residuals: Measurements in these six sums.
        division_sum, division_weight: Sum of the division statistic and of its weights.
        feature: (., 5) A, k, mu_x, mu_y about the centre, sigma (Eq. 51); NaN for none.
        feature_covariance: (., 5, 5).
    """

    z: Array
    normal: Array
    parts: Array
    measured: Mask
    points_fitted: Array
    misfit: Array
    distance_sum: Array
    noise_sum: Array
    exception_sum: Array
    exception_noise: Array
    raised_sum: Array
    raised_noise: Array
    residuals: Array
    division_sum: Array
    division_weight: Array
    feature: Array
    feature_covariance: Array

    def __init__(self, domain: Domain, max_cells: int) -> None:
        super().__init__(domain, max_cells)
        self._written: list[Index] = []
        self.declare("z", np.nan)
        self.declare("normal", np.nan, (3,))
        self.declare("parts", np.nan, (2, 3, 3))
        self.declare("measured", False, (), np.bool_)
        for name in _SUMS:
            self.declare(name, 0.0)
        self.declare("feature", np.nan, (5,))
        self.declare("feature_covariance", np.nan, (5, 5))
        self.plant()

    @property
    def estimated(self) -> Mask:
        """True for rows with a plane, measured or inherited."""
        return np.isfinite(self.z)

    def export_state(self) -> dict[str, NDArray[Any]]:
        """Every column of the leaves, in the order of their rows; copies."""
        return {name: getattr(self, name)[: self.count].copy() for name in self._empty}

    def import_state(self, columns: Mapping[str, NDArray[Any]]) -> None:
        """Take up the leaves of `export_state`, which tile this domain (not checked here)."""
        self.plant()
        count = len(columns["level"])
        self._reserve(count)
        self.count = count
        for name in self._empty:
            getattr(self, name)[:count] = columns[name]
        rows = np.arange(count)
        self._place(rows, *(columns[name].astype(np.intp) for name in ("level", "ix", "iy")))

    @property
    def range_part(self) -> Array:
        """(., 3, 3) covariance from range noise."""
        return self.parts[:, 0]

    @property
    def pose_part(self) -> Array:
        """(., 3, 3) covariance from pose error."""
        return self.parts[:, 1]

    def planes(self, rows: Index) -> Planes:
        """Planes of leaves ``rows`` about (x, y, z), so that d is zero."""
        return Planes(self.normal[rows], np.zeros(len(rows)), self.parts[rows])

    def set_planes(self, rows: Index, normal: Array, z: Array, parts: Array) -> None:
        """Write planes through (x, y, z); `mend` before covariances are read by others."""
        self.normal[rows], self.z[rows], self.parts[rows] = normal, z, parts
        self._written.append(rows)

    def set_fused(self, rows: Index, fused: Planes) -> None:
        """Write planes whose d is about the present (x, y, z): the origin moves to the plane."""
        rise = fused.d / fused.normal[:, 2]
        parts = fusion.move_up(fused.normal, fused.parts, rise)
        self.set_planes(rows, fused.normal, self.z[rows] + rise, parts)

    def mend(self) -> None:
        """Free the covariances written since the last time of round-off (``fusion.sound``)."""
        if self._written:
            rows = np.concatenate(self._written)
            self._written.clear()
            self.parts[rows] = fusion.sound(self.parts[rows].reshape(-1, 3, 3)).reshape(-1, 2, 3, 3)

    def divide(self, rows: Index) -> Index:
        """Divide leaves ``rows`` as far as ``max_cells`` allows; children inherit the plane.

        An inherited plane is the parent's moved to the child's centre, its covariance inflated by
        the parent's misfit m^2: m^2 on d, and m^2 / (size / 4)^2 on the tilt, a radian at most.

        Returns:
            The rows that were divided.
        """
        if not len(rows):
            return rows
        level = self.level[rows]
        normal, z, parts, misfit = (
            self.normal[rows],
            self.z[rows],
            self.parts[rows],
            self.misfit[rows],
        )
        children = self.split(rows)
        done = len(children)
        quarter = np.repeat(0.25 * self.domain.cell_size(level[:done]), 4)
        normal = np.repeat(normal[:done], 4, axis=0)
        delta = np.empty((4 * done, 3))
        delta[:, 0] = np.tile(2 * CHILD_X - 1, done) * quarter
        delta[:, 1] = np.tile(2 * CHILD_Y - 1, done) * quarter
        delta[:, 2] = -(normal[:, 0] * delta[:, 0] + normal[:, 1] * delta[:, 1]) / normal[:, 2]
        _, change = fusion.shift_origin(normal, np.zeros(4 * done), delta)
        parts = fusion.congruent(change[:, None], np.repeat(parts[:done], 4, axis=0))
        square = np.repeat(misfit[:done], 4)
        tilt = np.minimum(square / quarter**2, 1.0)
        parts[:, 0, 0, 0] += tilt
        parts[:, 0, 1, 1] += tilt
        parts[:, 0, 2, 2] += square
        self.set_planes(children.ravel(), normal, np.repeat(z[:done], 4) + delta[:, 2], parts)
        first = children[:, 0]
        self.measured[first] = False
        for name in _SUMS:
            getattr(self, name)[first] = 0.0
        self.feature[first] = np.nan
        self.feature_covariance[first] = np.nan
        return rows[:done]


_SUMS = (
    "points_fitted",
    "misfit",
    "distance_sum",
    "noise_sum",
    "exception_sum",
    "exception_noise",
    "raised_sum",
    "raised_noise",
    "residuals",
    "division_sum",
    "division_weight",
)
