# SPDX-License-Identifier: Apache-2.0
"""What one scan does to the leaves: fit, fuse, store, divide (paper IV.A, IV.C, IV.D)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import Config
from quadtree_lss.core.geometry import fusion, planes
from quadtree_lss.core.geometry.fusion import Planes
from quadtree_lss.core.geometry.planes import Moments
from quadtree_lss.core.geometry.rotations import skew
from quadtree_lss.core.mapping import division, fitting
from quadtree_lss.core.mapping.alignment import ScanAlignment
from quadtree_lss.core.mapping.division import GroupedPoints
from quadtree_lss.core.mapping.few_points import FewPoints
from quadtree_lss.core.mapping.fitting import Fit, SlopePrior
from quadtree_lss.core.mapping.rounds import Round
from quadtree_lss.core.mapping.statistics import FinalGroups, Residuals
from quadtree_lss.core.mapping.stored import StoredPoints
from quadtree_lss.core.sensing.register import RegisteredScan, compact, finest_of
from quadtree_lss.core.tree.leaves import Leaves

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


class ScanUpdate:
    """One scan on its way through the leaves.

    Lengths are taken about the scan's own centroid, so that sums of squares stay small.

    Attributes:
        divisions: Cells divided.
        refused: Divisions for which there was no room.
    """

    def __init__(
        self,
        leaves: Leaves,
        stored: StoredPoints,
        alignment: ScanAlignment,
        config: Config,
        scan: RegisteredScan,
    ) -> None:
        self.leaves = leaves
        self.stored = stored
        self.alignment = alignment
        self.config = config.mapping
        self.range_noise = config.lidar.range_noise
        self.scan = scan
        middle = scan.points.mean(axis=0)
        self.origin = scan.origin + middle
        self.points = np.ascontiguousarray((scan.points - middle).T)
        self.finest = finest_of(scan, leaves.domain)
        self.lidar = scan.pose.position - self.origin
        self.few = FewPoints(leaves, stored, self.config, self.range_noise, scan, self.lidar)
        self.divisions = 0
        self.refused = 0
        self._known = np.zeros(leaves.capacity, dtype=np.bool_)
        self._shift = np.zeros(leaves.capacity)

    def run(self) -> Residuals:
        """Fit, fuse and divide until no cell asks for it.

        Returns:
            The residuals about the planes of the leaves in which the points came to rest.
        """
        return self._settle(self.points, self.finest, first=True)

    def divide(self, rows: Index) -> Residuals | None:
        """Divide leaves ``rows`` that the scan's points came to rest in, and go on below them.

        Returns:
            The residuals of the points concerned; None if there was no room for any division.
        """
        leaf = self.leaves.leaf_of_finest[self.finest]
        mark = np.zeros(self.leaves.count, dtype=np.bool_)
        mark[self._divide(rows)] = True
        index = np.flatnonzero(mark[leaf])
        if not len(index):
            self.leaves.mend()
            return None
        return self._settle(self.points.take(index, axis=1), self.finest[index])

    def _divide(self, rows: Index) -> Index:
        divided = self.leaves.divide(rows)
        self._bequeath(divided)
        self.refused += len(rows) - len(divided)
        self.divisions += len(divided)
        return divided

    def _bequeath(self, divided: Index) -> None:
        """Children of leaves that earlier scans had measured keep what these said of the height.

        Their first fits know this scan's height alone, which its pose error shifts as it shifted
        the parent's: by the parent's fused plane less the parent's fit of this scan.
        """
        more = self.leaves.capacity - len(self._known)
        if more > 0:
            self._known = np.concatenate([self._known, np.zeros(more, dtype=np.bool_)])
            self._shift = np.concatenate([self._shift, np.zeros(more)])
        known = np.flatnonzero(self._known[divided])
        if len(known):
            # The first child has its parent's row; the others were appended, three a parent.
            fresh = self.leaves.count - 3 * len(divided) + 3 * known[:, None] + np.arange(3)
            self._known[fresh] = True
            self._shift[fresh] = self._shift[divided[known], None]

    def _settle(self, points: Array, finest: Index, first: bool = False) -> Residuals:
        final = FinalGroups(points.shape[1], self.origin)
        current = self._round(np.arange(points.shape[1]), points, finest)
        while True:
            rows = current.rows
            divided = self._divide(rows[self._fit(current, first)])
            first = False
            moved = np.zeros(len(rows), dtype=np.bool_)
            moved[np.searchsorted(rows, divided)] = True
            final.add(rows, current.moment, moved, current.group, current.index)
            if not len(divided):
                break
            again = np.flatnonzero(moved[current.group])
            index = current.index[again]
            current = self._round(index, current.points.take(again, axis=1), finest[index])
        self.few.nudge(self.origin)
        self.leaves.mend()
        return final.residuals(self.leaves, points)

    def _round(self, index: Index, points: Array, finest: Index) -> Round:
        leaf = self.leaves.leaf_of_finest[finest]
        rows, group = compact(leaf.astype(np.intp), self.leaves.count)
        moment = planes.moments(group, len(rows), points, self.lidar)
        centre = np.empty((len(rows), 2))
        centre[:, 0] = self.leaves.x[rows] - self.origin[0]
        centre[:, 1] = self.leaves.y[rows] - self.origin[1]
        return Round(rows, group, index, points, moment, centre)

    def _fit(self, current: Round, first: bool) -> Mask:
        """Fit and fuse the cells of a round; which of them (M,) ask to be divided."""
        leaves, rows, moment = self.leaves, current.rows, current.moment
        size = leaves.domain.cell_size(leaves.level[rows])
        prior = self._prior(rows, size)
        measured = leaves.measured[rows]
        waiting = self.stored.counts(rows, leaves.capacity) > 0
        sound = fitting.fittable(moment, size, prior, self.config, self.range_noise) & ~waiting
        fitted = np.flatnonzero(sound)
        part = moment.take(fitted)
        fit = fitting.fit_scan(
            part,
            current.centre[fitted],
            prior.take(fitted),
            self.config,
            self.range_noise,
            self.lidar,
            self.scan.pose_root,
        )
        if first:
            self._align(rows[fitted], measured[fitted], fit)
        statistic, mean_square = self._judge(current, fitted, fit, part)
        self._take(rows[fitted], measured[fitted], fit)
        leaves.points_fitted[rows[fitted]] += part.count
        if len(fitted) < len(rows):
            few = np.flatnonzero(~sound)
            known = np.isfinite(leaves.z[rows[few]])
            self.few.keep(rows[few[known]], moment.take(few[known]))
            self._fit_few(current, few[~known], size, prior)
        asks = np.zeros(len(rows), dtype=np.bool_)
        asks[fitted] = division.asks(
            leaves, rows[fitted], statistic, part.count, mean_square, self.config
        )
        return asks

    def _fit_few(self, current: Round, few: Index, size: Array, prior: SlopePrior) -> None:
        """First estimates of cells ``few`` from the points of several scans, where they suffice."""
        found = self.few.fit(current, few, size, prior, self.origin)
        if found is not None:
            rows, fit, count = found
            self._set(rows, np.arange(len(rows)), fit)
            self.leaves.points_fitted[rows] += count

    def _align(self, rows: Index, measured: Mask, fit: Fit) -> None:
        """Let the scan and the map meet at one height."""
        leaves = self.leaves
        again = rows[measured]
        rise = fit.z[measured] + self.origin[2] - leaves.z[again]
        own = fit.planes.parts[measured, 0, 2, 2] + leaves.parts[again, 0, 2, 2]
        own += leaves.misfit[again]
        down, lift = self.alignment.meet(rise, own, leaves.normal[again], self._ground_covariance())
        self.origin[2] -= down
        if lift != 0.0:
            leaves.z[: leaves.count] += lift
            self.stored.lift(lift)

    def _ground_covariance(self) -> Array:
        """Covariance (3, 3) that the pose error gives the middle of the scan's ground, m^2."""
        moved = np.concatenate([np.eye(3), skew(self.lidar)], axis=1) @ self.scan.pose_root
        return np.asarray(moved @ moved.T)

    def _prior(self, rows: Index, size: Array) -> SlopePrior:
        """An inherited plane tells its cell's slope, weakly."""
        leaves = self.leaves
        inherited = np.isfinite(leaves.z[rows]) & ~leaves.measured[rows]
        if self.config.fit != "height" or not inherited.any():
            flat = np.zeros((len(rows), 3))
            flat[:, 2] = 1.0
            return SlopePrior(flat, np.zeros(len(rows)))
        normal = np.where(inherited[:, None], leaves.normal[rows], (0.0, 0.0, 1.0))
        spread = self.config.slope_prior_points * size**2 / 12.0
        return SlopePrior(normal, np.where(inherited, spread, 0.0))

    def _judge(
        self, current: Round, fitted: Index, fit: Fit, moment: Moments
    ) -> tuple[Array, Array]:
        """Division statistic (M,) of the fitted cells and their mean square residual, m^2."""
        normal = fit.planes.normal
        squares = np.einsum("mi,mij,mj->m", normal, moment.scatter, normal)
        mean_square = np.maximum(squares, 0.0) / np.maximum(moment.count - 3.0, 1.0)
        seen = GroupedPoints(fitted, current.group, current.points, moment.count, len(current.rows))
        if self.config.division == "lack_of_fit":
            return division.lack_of_fit_statistic(fit, moment, seen), mean_square
        statistic = division.mahalanobis_statistic(
            self.leaves,
            current.rows[fitted],
            fit,
            moment,
            seen,
            self.origin,
            self.scan.pose,
            self.range_noise,
        )
        return statistic, mean_square

    def _take(self, rows: Index, measured: Mask, fit: Fit) -> None:
        """First estimates are taken as they are, later ones fused with the prior (IV.C)."""
        leaves = self.leaves
        self._set(rows, np.flatnonzero(~measured), fit)
        again = np.flatnonzero(measured)
        if not len(again):
            return
        later = rows[again]
        scanned = fit.z[again] + self.origin[2]
        prior = leaves.planes(later)
        update = Planes(fit.planes.normal[again], prior.d, fit.planes.parts[again])
        leaves.set_fused(later, fusion.fuse_pair(prior, update, scanned - leaves.z[later]))
        self._known[later] = True
        self._shift[later] = leaves.z[later] - scanned

    def _set(self, rows: Index, chosen: Index, fit: Fit) -> None:
        """First estimate of the leaves ``rows[chosen]``; see `_bequeath` for children."""
        if not len(chosen):
            return
        at = rows[chosen]
        parts = fit.planes.parts[chosen]
        known = np.flatnonzero(self._known[at])
        parts[known, 1] = self.leaves.parts[at[known], 1]
        z = fit.z[chosen] + self.origin[2] + self._shift[at]
        self.leaves.set_planes(at, fit.planes.normal[chosen], z, parts)
        self.leaves.measured[at] = True
