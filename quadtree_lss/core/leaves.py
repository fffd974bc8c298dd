# SPDX-License-Identifier: Apache-2.0
"""Leaves with their plane estimates and running statistics."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core import planes
from quadtree_lss.core.planes import Planes
from quadtree_lss.core.quadtree import CHILD_X, CHILD_Y, Domain, Quadtree

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


class Leaves(Quadtree):
    """The quadtree's leaves, each with a plane through (x, y, z) and what is counted on it.

    Attributes:
        z: Plane's elevation at the cell's centre, m; NaN without an estimate.
        normal: (., 3) upward unit normal.
        range_part, pose_part: (., 3, 3) covariance of (dphi_1, dphi_2, dd), d about (x, y, z).
        measured: True where own points were fitted, False if empty or inherited.
        points_fitted: Measurements in the estimate.
        misfit: Mean square orthogonal residual of the last scan about its own fit, m^2.
        distance_sum: Sum of |orthogonal distance| (Eq. 55), m.
        noise_sum: What range noise alone adds to ``distance_sum``, m.
        exception_sum: Sum of exception masses (Eq. 48).
        exception_noise: What range noise alone adds to ``exception_sum``.
        residuals: Measurements in these four sums.
        division_sum, division_weight: Sum of the division statistic and of its weights.
        feature: (., 5) A, k, mu_x, mu_y about the centre, sigma (Eq. 51); NaN for none.
        feature_covariance: (., 5, 5).
    """

    z: Array
    normal: Array
    range_part: Array
    pose_part: Array
    measured: Mask
    points_fitted: Array
    misfit: Array
    distance_sum: Array
    noise_sum: Array
    exception_sum: Array
    exception_noise: Array
    residuals: Array
    division_sum: Array
    division_weight: Array
    feature: Array
    feature_covariance: Array

    def __init__(self, domain: Domain, max_cells: int) -> None:
        super().__init__(domain, max_cells)
        self.declare("z", np.nan)
        self.declare("normal", np.nan, (3,))
        self.declare("range_part", np.nan, (3, 3))
        self.declare("pose_part", np.nan, (3, 3))
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

    def planes(self, rows: Index) -> Planes:
        """Planes of leaves ``rows`` about (x, y, z), so that d is zero."""
        return Planes(
            self.normal[rows], np.zeros(len(rows)), self.range_part[rows], self.pose_part[rows]
        )

    def set_planes(
        self, rows: Index, normal: Array, z: Array, range_part: Array, pose_part: Array
    ) -> None:
        """Write planes through (x, y, z)."""
        self.normal[rows], self.z[rows] = normal, z
        parts = planes.sound(np.concatenate([range_part, pose_part]))
        self.range_part[rows], self.pose_part[rows] = parts[: len(rows)], parts[len(rows) :]

    def set_fused(self, rows: Index, fused: Planes) -> None:
        """Write planes whose d is about the present (x, y, z): the origin moves to the plane."""
        rise = fused.d / fused.normal[:, 2]
        self.set_planes(
            rows,
            fused.normal,
            self.z[rows] + rise,
            planes.move_up(fused.normal, fused.range_part, rise),
            planes.move_up(fused.normal, fused.pose_part, rise),
        )

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
        normal, z = self.normal[rows], self.z[rows]
        range_part, pose_part, misfit = (
            self.range_part[rows],
            self.pose_part[rows],
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
        _, change = planes.shift_origin(normal, np.zeros(4 * done), delta)
        inflated = planes.congruent(change, np.repeat(range_part[:done], 4, axis=0))
        square = np.repeat(misfit[:done], 4)
        tilt = np.minimum(square / quarter**2, 1.0)
        inflated[:, 0, 0] += tilt
        inflated[:, 1, 1] += tilt
        inflated[:, 2, 2] += square
        pose = planes.congruent(change, np.repeat(pose_part[:done], 4, axis=0))
        at = children.ravel()
        self.set_planes(at, normal, np.repeat(z[:done], 4) + delta[:, 2], inflated, pose)
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
    "residuals",
    "division_sum",
    "division_weight",
)
