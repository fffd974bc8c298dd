# SPDX-License-Identifier: Apache-2.0
"""The map: what one scan does to it (paper IV)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core import division, planes, statistics
from quadtree_lss.core.config import Config
from quadtree_lss.core.features import FeatureEstimator
from quadtree_lss.core.fitting import Fit, SlopePrior, fit_scan, fit_scans, fittable, pose_variance
from quadtree_lss.core.leaves import Leaves
from quadtree_lss.core.lidar import Pose
from quadtree_lss.core.planes import Moments, Planes
from quadtree_lss.core.quadtree import CellMap, Domain, morton_order
from quadtree_lss.core.scan import RegisteredScan, compact, register
from quadtree_lss.core.stored import StoredPoints

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ScanReport:
    """What became of one scan.

    Attributes:
        stamp_ns: The scan's stamp.
        points: Points in the message.
        points_used: Points inside the domain, fitted or stored.
        dropped: Points that were not used, by reason (``scan.register``).
        leaves: Leaves after the scan.
        divisions: Cells divided by it.
        refused_divisions: Cells that ``mapping.max_cells`` left whole.
        refused_points: Points that found no room to be stored.
        noise_ratio: Observed over configured range noise (running median), NaN if unknown.
    """

    stamp_ns: int
    points: int
    points_used: int
    dropped: dict[str, int]
    leaves: int
    divisions: int
    refused_divisions: int
    refused_points: int
    noise_ratio: float


@dataclass
class _Round:
    """One pass over the cells that have points: all that were touched, then only new children.

    ``rows`` (M,) leaves, ``group`` (N,) place of each point's leaf among them, ``index`` (N,) the
    points, ``moment`` of the M groups about ``origin``.
    """

    rows: Index
    group: Index
    index: Index
    points: Array
    rays: Array
    moment: Moments


class Mapper:
    """Keeps the quadtree; ``update`` takes a scan and its pose, ``snapshot`` gives the map.

    Not thread-safe. A scan either enters whole or, if none of its points is sound, changes
    nothing.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        d = config.domain
        self.domain = Domain(d.xmin, d.ymin, d.size, d.min_level, d.max_level)
        self.leaves = Leaves(self.domain, config.mapping.max_cells)
        self._stored = StoredPoints(
            config.mapping.max_stored_points, config.mapping.max_stored_per_cell
        )
        self._features = FeatureEstimator(config.features)
        self._noise = statistics.NoiseCheck()
        self.observed = np.zeros(self.domain.finest_count**2, dtype=np.bool_)
        self.stamp_ns = 0

    def reset(self) -> None:
        """Forget everything that was mapped."""
        self.leaves.plant()
        self._stored.clear()
        self._noise = statistics.NoiseCheck()
        self.observed[:] = False
        self.stamp_ns = 0

    def update(self, points_lidar: Array, pose: Pose) -> ScanReport:
        """Map one scan.

        Args:
            points_lidar: (H, W, 3) organised or (N, 3), lidar axes (z boresight), m; rows that
                are not finite are no returns.
            pose: Lidar pose at the scan's stamp.
        """
        scan, dropped = register(points_lidar, pose, self.config.lidar, self.domain)
        divisions = refused = 0
        refused_before = self._stored.refused
        if len(scan.finest):
            self.observed[scan.finest] = True
            self.stamp_ns = max(self.stamp_ns, pose.stamp_ns)
            divisions, refused = self._map(scan)
        return ScanReport(
            stamp_ns=pose.stamp_ns,
            points=points_lidar.size // 3,
            points_used=len(scan.finest),
            dropped=dropped,
            leaves=self.leaves.count,
            divisions=divisions,
            refused_divisions=refused,
            refused_points=self._stored.refused - refused_before,
            noise_ratio=self._noise.ratio,
        )

    def _map(self, scan: RegisteredScan) -> tuple[int, int]:
        """Fit, fuse, divide until no cell asks for it, then update the running statistics."""
        origin = scan.points.mean(axis=1)
        points = scan.points - origin[:, None]
        lidar = scan.pose.position - origin
        key = self._stored.open_scan(scan)
        final = statistics.FinalGroups(points.shape[1], origin)
        divisions = refused = 0
        index = np.arange(points.shape[1])
        current = self._round(scan, index, points, scan.rays)
        while True:
            rows = current.rows
            wants = self._fit_round(current, scan, origin, lidar, key)
            divided = self.leaves.divide(rows[wants])
            refused += int(np.count_nonzero(wants)) - len(divided)
            divisions += len(divided)
            moved = np.zeros(len(rows), dtype=np.bool_)
            moved[np.searchsorted(rows, divided)] = True
            final.add(rows, current.moment, moved, current.group, current.index)
            if not len(divided):
                break
            again = moved[current.group]
            current = self._round(
                scan, current.index[again], current.points[:, again], current.rays[:, again]
            )
        self._stored.close_scan()
        self._accumulate(final, points)
        return divisions, refused

    def _round(self, scan: RegisteredScan, index: Index, points: Array, rays: Array) -> _Round:
        leaf = self.leaves.leaf_of_finest[scan.finest[index]]
        rows, group = compact(leaf, self.leaves.count)
        return _Round(rows, group, index, points, rays, planes.moments(group, len(rows), points, rays))

    def _prior(self, rows: Index) -> SlopePrior:
        """An inherited plane tells its cell's slope, weakly."""
        leaves = self.leaves
        inherited = leaves.estimated[rows] & ~leaves.measured[rows]
        normal = np.where(inherited[:, None], leaves.normal[rows], (0.0, 0.0, 1.0))
        if self.config.mapping.fit != "height":
            return SlopePrior(normal, np.zeros(len(rows)))
        size = self.domain.cell_size(leaves.level[rows])
        spread = self.config.mapping.slope_prior_points * size**2 / 12.0
        return SlopePrior(normal, np.where(inherited, spread, 0.0))

    def _fit_round(
        self, current: _Round, scan: RegisteredScan, origin: Array, lidar: Array, key: int
    ) -> Mask:
        """Fit and fuse the cells of a round; which of them (M,) ask to be divided."""
        config, leaves = self.config.mapping, self.leaves
        noise = self.config.lidar.range_noise
        rows, moment = current.rows, current.moment
        centre = np.column_stack([leaves.x[rows] - origin[0], leaves.y[rows] - origin[1]])
        prior = self._prior(rows)
        measured = leaves.measured[rows]
        waiting = ~measured & (self._stored.counts(rows, leaves.capacity) > 0)
        sound = fittable(moment, prior, config, noise) & ~waiting
        fitted = np.flatnonzero(sound)
        fit = fit_scan(
            moment.take(fitted), centre[fitted], prior.take(fitted), config, noise, lidar, scan.pose_root
        )
        part = moment.take(fitted)
        statistic, mean_square = self._judge(current, scan, fitted, fit, part, origin)
        self._take(rows[fitted], measured[fitted], fit, origin[2])
        self._nudge(rows, measured & ~sound, moment, scan, origin, lidar)
        self._store(current, np.flatnonzero(~measured & ~sound), prior, centre, scan, origin, key)
        leaves.points_fitted[rows] += np.where(leaves.measured[rows], moment.count, 0.0)
        asks = np.zeros(len(rows), dtype=np.bool_)
        asks[fitted] = division.asks(
            leaves, rows[fitted], statistic, part.count, mean_square, config
        )
        return asks

    def _judge(
        self,
        current: _Round,
        scan: RegisteredScan,
        fitted: Index,
        fit: Fit,
        moment: Moments,
        origin: Array,
    ) -> tuple[Array, Array]:
        """Division statistic (M,) of the fitted cells and mean square residual (M,), m^2."""
        place = np.full(len(current.rows), -1, dtype=np.intp)
        place[fitted] = np.arange(len(fitted))
        group, points = place[current.group], current.points
        if len(fitted) < len(current.rows):
            inside = np.flatnonzero(group >= 0)
            group, points = group[inside], points[:, inside]
        normal = fit.planes.normal
        squares = np.einsum("mi,mij,mj->m", normal, moment.scatter, normal)
        mean_square = np.maximum(squares, 0.0) / np.maximum(moment.count - 3.0, 1.0)
        if self.config.mapping.division == "lack_of_fit":
            return division.lack_of_fit_statistic(fit, moment, group, points), mean_square
        return division.mahalanobis_statistic(
            self.leaves,
            current.rows[fitted],
            fit,
            moment,
            group,
            points,
            origin,
            scan.pose,
            self.config.lidar.range_noise,
        ), mean_square

    def _take(self, rows: Index, measured: Mask, fit: Fit, origin_z: float) -> None:
        """First estimates are taken as they are, later ones fused with the prior (IV.C)."""
        leaves = self.leaves
        fresh = np.flatnonzero(~measured)
        first = rows[fresh]
        leaves.set_planes(
            first,
            fit.planes.normal[fresh],
            fit.z[fresh] + origin_z,
            fit.planes.range_part[fresh],
            fit.planes.pose_part[fresh],
        )
        leaves.measured[first] = True
        again = np.flatnonzero(measured)
        if not len(again):
            return
        later = rows[again]
        prior = leaves.planes(later)
        normal = fit.planes.normal[again]
        rise = fit.z[again] + origin_z - leaves.z[later]
        update = Planes(
            normal,
            normal[:, 2] * rise,
            planes.move_up(normal, fit.planes.range_part[again], -rise),
            planes.move_up(normal, fit.planes.pose_part[again], -rise),
        )
        leaves.set_fused(later, planes.fuse_pair(prior, update))

    def _nudge(
        self, rows: Index, few: Mask, moment: Moments, scan: RegisteredScan, origin: Array, lidar: Array
    ) -> None:
        """Cells with a plane and too few new points for another: fuse the points' mean height."""
        chosen = np.flatnonzero(few)
        if not len(chosen):
            return
        leaves, at = self.leaves, rows[chosen]
        part = moment.take(chosen)
        prior = leaves.planes(at)
        lever3 = part.mean + origin - np.column_stack([leaves.x[at], leaves.y[at], leaves.z[at]])
        basis = planes.sphere.tangent_basis(prior.normal)
        lever = np.einsum("mij,mi->mj", basis, lever3)
        height = np.einsum("mi,mi->m", prior.normal, lever3)
        variance = planes.orthogonal_noise_variance(
            prior.normal, part.ray, self.config.lidar.range_noise
        )
        pose = pose_variance(prior.normal, part.mean - lidar, scan.pose_root)
        if self.config.mapping.covariance == "independent":
            variance, pose = variance + pose, np.zeros_like(pose)
        fused = planes.fuse_heights(prior, lever, height, variance / part.count, pose)
        leaves.set_fused(at, fused)

    def _store(
        self,
        current: _Round,
        few: Index,
        prior: SlopePrior,
        centre: Array,
        scan: RegisteredScan,
        origin: Array,
        key: int,
    ) -> None:
        """Cells without a measured plane and too few points of this scan: fit with what was stored
        before, or store."""
        if not len(few):
            return
        rows = current.rows[few]
        place = np.full(len(current.rows), -1, dtype=np.intp)
        place[few] = np.arange(len(few))
        cell_of_point = place[current.group]
        mine = np.flatnonzero(cell_of_point >= 0)
        cell_of_point = cell_of_point[mine]
        fitted = np.zeros(len(few), dtype=np.bool_)
        self._stored.counts(rows, self.leaves.capacity)
        old = self._stored.of(rows)
        if len(old):
            place_of_row = np.zeros(self.leaves.capacity, dtype=np.intp)
            place_of_row[rows] = np.arange(len(rows))
            cell = np.concatenate([place_of_row[self._stored.row[old]], cell_of_point])
            scans, which = np.unique(
                np.concatenate([self._stored.scan[old], np.full(len(mine), key)]),
                return_inverse=True,
            )
            pairs, group = np.unique(cell * len(scans) + which, return_inverse=True)
            points = np.concatenate(
                [self._stored.points[:, old] - origin[:, None], current.points[:, mine]], axis=1
            )
            rays = np.concatenate([self._stored.rays[:, old], current.rays[:, mine]], axis=1)
            lidars, roots = self._stored.poses(scans)
            fit, fitted = fit_scans(
                planes.moments(group, len(pairs), points, rays),
                pairs // len(scans),
                pairs % len(scans),
                centre[few],
                prior.take(few),
                self.config.mapping,
                self.config.lidar.range_noise,
                lidars - origin,
                roots,
            )
            chosen = np.flatnonzero(fitted)
            at = rows[chosen]
            self.leaves.set_planes(
                at,
                fit.planes.normal[chosen],
                fit.z[chosen] + origin[2],
                fit.planes.range_part[chosen],
                fit.planes.pose_part[chosen],
            )
            self.leaves.measured[at] = True
            self.leaves.points_fitted[at] += self._stored.per_row[at]
            self._stored.drop(at)
        left = ~fitted[cell_of_point]
        kept = mine[left]
        if len(kept):
            self._stored.add(
                rows[cell_of_point[left]],
                key,
                current.points[:, kept] + origin[:, None],
                current.rays[:, kept],
            )

    def _accumulate(self, final: statistics.FinalGroups, points: Array) -> None:
        """Roughness, exceptions and subscale features of the leaves that the scan ended in."""
        residuals = final.residuals(self.leaves, points)
        statistics.accumulate(
            self.leaves, residuals, self.config.mapping, self.config.lidar.range_noise
        )
        self._noise.add(self.leaves, residuals, self.config.lidar.range_noise)
        self._features.update(self.leaves, residuals, self.config.lidar.range_noise)

    def snapshot(self) -> CellMap:
        """The map as it stands; copies, so that later scans do not change it."""
        leaves, count, n = self.leaves, self.leaves.count, self.domain.finest_count
        order = morton_order(
            self.domain, leaves.level[:count], leaves.ix[:count], leaves.iy[:count]
        )
        roughness, exceptions = statistics.densities(leaves, order)
        return CellMap(
            stamp_ns=self.stamp_ns,
            domain=self.domain,
            level=leaves.level[order],
            ix=leaves.ix[order].astype(np.uint32),
            iy=leaves.iy[order].astype(np.uint32),
            z=leaves.z[order],
            normal=leaves.normal[order],
            covariance_range=leaves.range_part[order],
            covariance_pose=leaves.pose_part[order],
            count=leaves.points_fitted[order].astype(np.uint32),
            measured=leaves.measured[order],
            roughness=roughness,
            exception_fraction=exceptions,
            feature=leaves.feature[order],
            observed=self.observed.reshape(n, n).copy(),
        )
