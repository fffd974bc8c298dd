# SPDX-License-Identifier: Apache-2.0
"""The map: what one scan does to it (paper IV)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import Config
from quadtree_lss.core.geometry.feature import as_boulder
from quadtree_lss.core.mapping import division, statistics
from quadtree_lss.core.mapping.alignment import ScanAlignment
from quadtree_lss.core.mapping.features import FeatureEstimator
from quadtree_lss.core.mapping.stored import StoredPoints
from quadtree_lss.core.mapping.update import ScanUpdate
from quadtree_lss.core.sensing.lidar import Pose
from quadtree_lss.core.sensing.pose_buffer import SECOND_NS
from quadtree_lss.core.sensing.register import Points, finest_of, register
from quadtree_lss.core.sensing.sweep import Sweep
from quadtree_lss.core.tree.leaves import Leaves
from quadtree_lss.core.tree.quadtree import CellMap, Domain, morton_order

Array = NDArray[np.float64]
Index = NDArray[np.intp]

#: A scan older than the map by more than this is no late one: time jumped back (`ScanQueue`).
JUMP_NS = SECOND_NS


@dataclass(frozen=True)
class ScanReport:
    """What became of one scan.

    Attributes:
        stamp_ns: The scan's stamp.
        points: Points in the message.
        points_used: Points that entered the map, fitted or stored.
        dropped: Points that were unsound or outside, by reason (``scan.register``).
        leaves: Leaves after the scan.
        divisions: Cells divided by it.
        refused_divisions: Cells that ``mapping.max_cells`` left whole.
        refused_points: Points that found no room to be stored; with ``points_used`` and
            ``dropped`` they are all points.
        noise_ratio: Observed over configured range noise (running mean of the scans' medians), NaN
            if unknown.
        centre: x and y of the middle of the sound returns, map frame, m; None if there was none.
        offset: By how much the scan's ground lay off the map's by its pose (x, y, z), m; 0 without
            ``mapping.align``.
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
    centre: tuple[float, float] | None
    offset: tuple[float, float, float]


class Mapper:
    """Keeps the quadtree; ``update`` takes a scan and its pose, ``snapshot`` gives the map.

    Not thread-safe. A scan either enters whole or, if none of its points is sound, changes
    nothing.

    Attributes:
        stamp_ns: Stamp of the newest scan since time last jumped back (a looping bag, a clock set
            right); leaves may be of scans with later stamps then. 0 if nothing is mapped.
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
        self._alignment = ScanAlignment(config.mapping)
        self.observed = np.zeros(self.domain.finest_count**2, dtype=np.bool_)
        self.stamp_ns = 0

    def reset(self) -> None:
        """Forget everything that was mapped."""
        self.leaves.plant()
        self._stored.clear()
        self._noise = statistics.NoiseCheck()
        self._alignment.reset()
        self.observed[:] = False
        self.stamp_ns = 0

    def export_state(self) -> dict[str, NDArray[Any]]:
        """All that a mapper must know to go on, by name; copies (see ``core.checkpoint``)."""
        parts = {name: part.export_state() for name, part in self._parts().items()}
        return {
            **{f"{name}.{key}": value for name, of in parts.items() for key, value in of.items()},
            "observed": self.observed.copy(),
            "stamp_ns": np.array(self.stamp_ns),
        }

    def import_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Go on from `export_state` of a mapper of the same domain (not checked here)."""
        self.reset()
        for name, part in self._parts().items():
            start = f"{name}."
            part.import_state({k[len(start) :]: v for k, v in state.items() if k.startswith(start)})
        self.observed[:] = state["observed"]
        self.stamp_ns = int(state["stamp_ns"])

    def _parts(self) -> dict[str, Leaves | StoredPoints | ScanAlignment]:
        return {"leaves": self.leaves, "stored": self._stored, "alignment": self._alignment}

    def update(self, points_lidar: Points, pose: Pose, sweep: Sweep | None = None) -> ScanReport:
        """Map one scan.

        Args:
            points_lidar: (H, W, 3) organised or (N, 3), lidar axes (z boresight), m; rows that
                are not finite are no returns.
            pose: Lidar pose at the scan's stamp.
            sweep: How the lidar moved while it took the scan; None if at once.
        """
        pose = self._alignment.predicted(pose)
        scan, dropped = register(points_lidar, pose, self.config.lidar, self.domain, sweep)
        refused_before = self._stored.refused
        divisions = refused = 0
        if len(scan.key):
            self.observed[finest_of(scan, self.domain)] = True
            if not self.stamp_ns - JUMP_NS <= pose.stamp_ns <= self.stamp_ns:
                self.stamp_ns = pose.stamp_ns
            change = ScanUpdate(self.leaves, self._stored, self._alignment, self.config, scan)
            residuals = self._accumulate(change.run())
            while len(rocky := self._rocky(residuals.rows)):
                below = change.divide(rocky)
                if below is None:
                    break
                residuals = self._accumulate(below)
            self._stored.close_scan()
            divisions, refused = change.divisions, change.refused
        refused_points = self._stored.refused - refused_before
        return ScanReport(
            stamp_ns=pose.stamp_ns,
            points=points_lidar.size // 3,
            points_used=len(scan.key) - refused_points,
            dropped=dropped,
            leaves=self.leaves.count,
            divisions=divisions,
            refused_divisions=refused,
            refused_points=refused_points,
            noise_ratio=self._noise.ratio,
            centre=scan.centre,
            offset=self._alignment.offset,
        )

    def _rocky(self, rows: Index) -> Index:
        config = self.config
        noise = config.lidar.range_noise
        return rows[division.hides_rock(self.leaves, rows, config.mapping, config.features, noise)]

    def _accumulate(self, residuals: statistics.Residuals) -> statistics.Residuals:
        """Roughness, exceptions, noise check and subscale features of the leaves of a scan."""
        config, noise = self.config, self.config.lidar.range_noise
        height = division.rock_height(config.features, noise)
        statistics.accumulate(self.leaves, residuals, config.mapping, noise, height)
        self._noise.add(self.leaves, residuals, noise)
        self._features.update(self.leaves, residuals, noise)
        return residuals

    def _pose_covariance(self, rows: Index) -> Array:
        """Covariance (M, 3, 3) from pose error. The leaves take the errors of their scans for
        independent; of the height that all have in common they cannot know more than the map."""
        out = self.leaves.pose_part[rows]
        common = self._alignment.height_variance * self.leaves.normal[rows, 2] ** 2
        out[:, 2, 2] = np.maximum(out[:, 2, 2], common)
        return out

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
            covariance_pose=self._pose_covariance(order),
            count=leaves.points_fitted[order].astype(np.uint32),
            measured=leaves.measured[order],
            roughness=roughness,
            exception_fraction=exceptions,
            feature=as_boulder(leaves.feature[order]),
            observed=self.observed.reshape(n, n).copy(),
        )
