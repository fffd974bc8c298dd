# SPDX-License-Identifier: Apache-2.0
"""Cells in which a scan has too few points for a plane (paper IV.A)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import MappingConfig
from quadtree_lss.core.geometry import fusion, planes, sphere
from quadtree_lss.core.geometry.planes import Moments
from quadtree_lss.core.mapping import fitting
from quadtree_lss.core.mapping.fitting import Fit, SlopePrior
from quadtree_lss.core.mapping.rounds import Round
from quadtree_lss.core.mapping.stored import StoredPoints
from quadtree_lss.core.sensing.register import RegisteredScan
from quadtree_lss.core.tree.leaves import Leaves

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class _Pool:
    """Points that are fitted together.

    Attributes:
        old: (K,) which of the stored ones.
        new: (N,) which of the round's.
        cell: (N,) cell of each new one, 0 .. F - 1.
        origin: (3,) of the round's points in the map frame, m.
    """

    old: Index
    new: Index
    cell: Index
    origin: Array


class FewPoints:
    """What becomes of the points of one scan in such cells.

    Where the cell has a plane, its own or inherited, their mean height is fused into it. Where it
    has none they wait, each with its scan, until the points of several scans suffice.
    """

    def __init__(
        self,
        leaves: Leaves,
        stored: StoredPoints,
        config: MappingConfig,
        range_noise: float,
        scan: RegisteredScan,
        lidar: Array,
    ) -> None:
        self.leaves = leaves
        self.stored = stored
        self.config = config
        self.range_noise = range_noise
        self.scan = scan
        self.lidar = lidar
        self.key = stored.open_scan(scan)
        self._kept: list[tuple[Index, Moments]] = []

    def keep(self, rows: Index, moment: Moments) -> None:
        """Points of leaves (K,) that have a plane; see `nudge`."""
        self._kept.append((rows, moment))

    def nudge(self, origin: Array) -> None:
        """Fuse the mean height of the points that were `kept` into the planes of their cells.

        None of these cells is divided, so once for all rounds of a scan is enough.

        Args:
            origin: (3,) of the moments in the map frame, m.
        """
        few, self._kept = self._kept, []
        rows = np.concatenate([rows for rows, _ in few]) if few else np.empty(0, dtype=np.intp)
        if not len(rows):
            return
        moment = planes.join([moment for _, moment in few])
        leaves, lidar = self.leaves, self.lidar
        prior = leaves.planes(rows)
        arm = moment.mean + origin
        arm -= np.column_stack([leaves.x[rows], leaves.y[rows], leaves.z[rows]])
        basis = sphere.tangent_basis(prior.normal)
        lever = np.einsum("mij,mi->mj", basis, arm)
        height = np.einsum("mi,mi->m", prior.normal, arm)
        noise = planes.orthogonal_noise_variance(prior.normal, moment.ray, self.range_noise)
        pose = fitting.pose_variance(prior.normal, moment.mean - lidar, self.scan.pose_root)
        if self.config.covariance == "independent":
            noise, pose = noise + pose, np.zeros_like(pose)
        fused = fusion.fuse_heights(prior, lever, height, noise / moment.count, pose)
        leaves.set_fused(rows, fused)
        leaves.measured[rows] = True
        leaves.points_fitted[rows] += moment.count

    def fit(
        self, current: Round, few: Index, size: Array, prior: SlopePrior, origin: Array
    ) -> tuple[Index, Fit, Array] | None:
        """Fit cells without a plane with what was stored before, or store their points.

        Args:
            few: (F,) which cells of the round.
            size, prior: Of all cells of the round.
            origin: (3,) of the round's points in the map frame, m.

        Returns:
            The leaves that were fitted, their fits and numbers of points; None if none was.
        """
        if not len(few):
            return None
        rows = current.rows[few]
        place = np.full(len(current.rows), -1, dtype=np.intp)
        place[few] = np.arange(len(few))
        cell = place[current.group]
        mine = np.flatnonzero(cell >= 0)
        cell = cell[mine]
        old = self.stored.of(rows)
        together = self.stored.per_row[rows] + current.moment.count[few]
        found = None
        if len(old) and together.max() >= self.config.min_points:
            points = _Pool(old, mine, cell, origin)
            fitted, found = self._fit_together(current, few, size[few], prior.take(few), points)
            left = np.flatnonzero(~fitted[cell])
            mine, cell = mine[left], cell[left]
        if len(mine):
            away = current.points.take(mine, axis=1) + origin[:, None]
            self.stored.add(rows[cell], self.key, away)
        return found

    def _fit_together(
        self,
        current: Round,
        few: Index,
        size: Array,
        prior: SlopePrior,
        pool: _Pool,
    ) -> tuple[Mask, tuple[Index, Fit, Array] | None]:
        """Fit the cells ``few`` with the points of all scans; which (F,) could be, and as `fit`."""
        stored, rows = self.stored, current.rows[few]
        place_of_row = np.zeros(self.leaves.capacity, dtype=np.intp)
        place_of_row[rows] = np.arange(len(rows))
        every = np.concatenate([place_of_row[stored.row[pool.old]], pool.cell])
        of_scan = np.concatenate([stored.scan[pool.old], np.full(len(pool.new), self.key)])
        keys, which = np.unique(of_scan, return_inverse=True)
        pairs, group = np.unique(every * len(keys) + which, return_inverse=True)
        before = stored.points[:, pool.old] - pool.origin[:, None]
        points = np.concatenate([before, current.points[:, pool.new]], axis=1)
        lidars, roots = stored.poses(keys)
        lidars = lidars - pool.origin
        scan = pairs % len(keys)
        moment = planes.moments(group, len(pairs), points, lidars[scan])
        place = pairs // len(keys)
        pooled, _, enough = fitting.pool_scans(moment, place, len(few), self.config.min_points)
        good = enough & fitting.fittable(pooled, size, prior, self.config, self.range_noise)
        chosen = np.flatnonzero(good)
        if not len(chosen):
            return good, None
        part = np.flatnonzero(good[place])
        fit = fitting.fit_scans(
            moment.take(part),
            (np.cumsum(good) - 1)[place[part]],
            scan[part],
            current.centre[few[chosen]],
            prior.take(chosen),
            self.config,
            self.range_noise,
            lidars,
            roots,
        )
        at = rows[chosen]
        stored.drop(at)
        return good, (at, fit, pooled.count[chosen])
