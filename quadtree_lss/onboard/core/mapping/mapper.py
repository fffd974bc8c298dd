# SPDX-License-Identifier: Apache-2.0
"""Mapping of scans into the quadtree (paper IV), in six steps:

1. ``register``: points and pose -> points about the lidar, ordered by finest cell; drops by reason
2. ``ScanUpdate``: points -> a run of points for each touched leaf
3. ``ScanUpdate.fit``: runs -> planes, and their heights over the map
4. ``alignment``: heights -> the scan is accepted, rejected, or overrules the map; height offset
5. ``ScanUpdate.update_leaves``: planes -> fused leaves, divided where a plane does not suffice
6. ``ScanReport``: what happened to the scan
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array, Points, keep_memory
from quadtree_lss.onboard.config.settings import DEFAULTS, Config
from quadtree_lss.onboard.core.mapping import alignment, update
from quadtree_lss.onboard.core.mapping.alignment import RejectedScans, RigidMotion, Verdict
from quadtree_lss.onboard.core.mapping.measure import Rules, unobserved_parts
from quadtree_lss.onboard.core.mapping.update import ScanUpdate
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.points import Workspace
from quadtree_lss.onboard.core.sensing.pose_buffer import JUMP_NS
from quadtree_lss.onboard.core.sensing.register import (
    ABOVE,
    CONTRADICTION,
    RegisteredScan,
    register,
)
from quadtree_lss.onboard.core.sensing.sweep import Sweep
from quadtree_lss.onboard.core.tree import checkpoint
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.checkpoint import State
from quadtree_lss.onboard.core.tree.columns import leaf_columns
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.held_returns import HeldReturns
from quadtree_lss.onboard.core.tree.leaves import EXPLAINED, OBSERVED, LeafTable, to_grid

#: Least number of cells of a scan for an estimate of the range noise.
NOISE_CELLS = 3
#: Share of a new scan in the running mean of the observed range noise.
NOISE_SHARE = 0.1
#: Number of scans in the median of `Mapper.unexplained_offset`.
OFFSET_SCANS = 20
#: Offsets that exceed so many standard deviations contradict the covariances of the poses. The
#: median of `OFFSET_SCANS` scans does so only if the errors are 4.5 times as large as claimed.
OFFSET_SIGMAS = 3.0


@dataclass(frozen=True)
class ScanReport:
    """Result of mapping one scan.

    Attributes:
        stamp_ns: Stamp of the scan.
        points, points_used: Points in the message, and those that entered the map; the others are
            in ``dropped``.
        dropped: Number of dropped points by reason (``sensing.register``); ``contradiction`` for
            the other points of a rejected scan. ``isolated`` ones are held back, see ``admitted``.
        leaves: Leaves after the scan.
        divisions, refused_divisions: Cells that the scan divided, and that ``mapping.max_cells``
            left undivided.
        noise_ratio: Observed over configured range noise, NaN if unknown.
        centre: If all returns are outside the domain: x and y of their mean, map frame, m.
        offset: Height of the scan over the map by its pose, m; 0 if not compared.
        overruled: Whether this scan lifted or restarted the map.
        admitted: Isolated returns of earlier scans that this scan confirmed.
    """

    stamp_ns: int
    points: int
    points_used: int
    dropped: dict[str, int]
    leaves: int
    divisions: int
    refused_divisions: int
    noise_ratio: float
    centre: tuple[float, float] | None
    offset: float
    overruled: bool = False
    admitted: int = 0


class Mapper:
    """Builds the quadtree map: ``update`` maps a scan with its pose, ``snapshot`` copies the map.

    Not thread-safe. A scan enters as a whole, or changes no cell if none of its points is usable or
    it contradicts the map. With ``domain.follow`` the square then moves. Scans without a mapped
    point move it only after `OVERRULING_SCANS` in a row, so that a wrong pose does not discard it.

    Attributes:
        config: The configuration.
        leaves: The table of leaves.
        stamp_ns: Stamp of the newest scan since time last jumped back (looping bag, clock set
            back); 0 if nothing is mapped.
    """

    def __init__(self, config: Config = DEFAULTS) -> None:
        keep_memory()
        self.config = config
        self.leaves = LeafTable(Domain.of(config.domain), config.mapping.max_cells)
        self._area: tuple[float, float] | None = None
        self._rules = Rules(config)
        self._workspace = Workspace()
        self._buffers = update.ScanBuffers()
        self._correlation_time = config.pose.correlation_time  # of pose errors, s
        self._length_unit = config.vehicle.clearance_ratio  # scale of the lengths in `alignment`
        self.reset()

    @property
    def domain(self) -> Domain:
        """Current square of the map."""
        domain: Domain = self.leaves.domain
        return domain

    def set_area(self, area: ArrayLike | None) -> None:
        """Set the landing area (V, 2), m, that the square follows with ``domain.follow: area``,
        from the next scan on. Raises `ValueError`: it is not a polygon."""
        self._area = None
        if area is not None and self.config.domain.follow == "area":
            corners = np.asarray(area, dtype=np.float64).reshape(-1, 2)
            x, y = (0.5 * (corners.min(axis=0) + corners.max(axis=0))).tolist()
            self._area = x, y

    def reset(self) -> None:
        """Clear the map."""
        self.leaves.reset()
        self._held = HeldReturns(self.domain)
        self.stamp_ns = 0
        self._start_ns = 0
        self._noise_ratio = float("nan")
        # Height of the last compared scan over the map by its pose, m, and its variance, m^2.
        self._last_offset = (float("nan"), float("nan"))
        self._rejected = RejectedScans()
        # Lift of the map that is known and too small to be applied yet, m.
        self._pending_offset = 0.0
        # Pose and beams of the last scan that added coverage.
        self._view: tuple[Pose, Array] | None = None
        self._unmapped_scans = 0  # in a row
        # Last scans: squared height over the map, its variance from the claimed pose errors,
        # and from other causes, m^2.
        self._recent_offsets: deque[tuple[float, float, float]] = deque(maxlen=OFFSET_SCANS)

    def update(self, points_lidar: Points, pose: Pose, sweep: Sweep | None = None) -> ScanReport:
        """Map one scan.

        Args:
            points_lidar: (H, W, 3) organised or (N, 3) points in lidar axes (z boresight), m; rows
                that are not finite are not returns.
            pose: Of the lidar at the scan's stamp.
            sweep: Motion of the lidar during the scan, None for an instantaneous one.

        Raises:
            TypeError: The pose is not a `Pose`.
            ValueError: The points have another shape.
        """
        _check_arguments(points_lidar, pose)
        if not self.stamp_ns or self.config.domain.follow == "area":
            self._follow(pose)  # the map is empty, or the area sets the square
        if pose.stamp_ns < self.stamp_ns - JUMP_NS:
            self._held = HeldReturns(self.domain)
        lidar = self.config.lidar
        scan, dropped = register(
            points_lidar, pose, lidar, self.domain, sweep, self._held, self._workspace
        )
        used, offset, verdict = len(scan.key) - scan.admitted, 0.0, Verdict.ACCEPTED
        divisions = refused = 0
        if used:
            now = 1e-9 * (pose.stamp_ns - (self._start_ns or pose.stamp_ns))
            scan_update, cells, verdict = self._compare_and_decide(scan, now)
            if verdict is Verdict.REJECTED:
                dropped[CONTRADICTION] = used
                used, offset = 0, self._rejected.height
            else:
                if not self.stamp_ns - JUMP_NS <= pose.stamp_ns <= self.stamp_ns:
                    self.stamp_ns = pose.stamp_ns
                self._start_ns = self._start_ns or pose.stamp_ns
                if not self.config.mapping.by_paper("covariance"):
                    offset = self._align(scan_update, cells, now)
                adds_coverage = self._remember_new_view(pose, points_lidar)
                self._update_noise_ratio(scan_update.update_leaves(adds_coverage))
                divisions, refused = scan_update.divisions, scan_update.refused
        # Isolated returns wait for other scans, unless returns `ABOVE` show that the pose is wrong.
        if verdict is not Verdict.REJECTED and ABOVE not in dropped:
            self._held.scans += 1
            if scan.isolated is not None and verdict is Verdict.ACCEPTED:
                self._held.keep(scan.isolated)
        self._unmapped_scans = 0 if used else self._unmapped_scans + 1
        if used or self._unmapped_scans >= alignment.OVERRULING_SCANS:
            self._follow(pose)
        return ScanReport(
            stamp_ns=pose.stamp_ns,
            points=points_lidar.size // 3,
            points_used=used,
            dropped=dropped,
            leaves=self.leaves.count,
            divisions=divisions,
            refused_divisions=refused,
            noise_ratio=self._noise_ratio,
            centre=scan.centre,
            offset=offset,
            overruled=verdict is Verdict.OVERRULES,
            admitted=scan.admitted if used else 0,
        )

    def _remember_new_view(self, pose: Pose, points_lidar: Points) -> bool:
        """Return whether a scan adds coverage, and if so remember its pose and beams."""
        beams, correlation_time = update.sampled_beams(points_lidar), self._correlation_time
        if self._view is not None:
            elapsed = 1e-9 * abs(pose.stamp_ns - self._view[0].stamp_ns)
            # Share of the variance of pose errors that is new since the last view.
            independent = 1.0
            if correlation_time > 0.0:
                independent = -math.expm1(-elapsed / correlation_time)
            if not update.is_new_view(pose, beams, *self._view, independent):
                return False
        self._view = pose, beams
        return True

    def _follow(self, pose: Pose) -> None:
        """Move the square towards the followed point."""
        if self.config.domain.follow == "none":
            return
        followed = pose.position[:2].tolist()
        if self.config.domain.follow == "area":
            followed = self._area
        if followed is not None:
            east, north = self.domain.steps_to(*followed)
            if east or north:
                self.leaves.follow(east, north)
                cells = 1 << (self.domain.max_level - self.domain.min_level)
                self._held.follow(east * cells, north * cells)

    def _compare_and_decide(
        self, scan: RegisteredScan, now: float
    ) -> tuple[ScanUpdate, Array, Verdict]:
        """Fit a scan to the leaves and accept or reject it. If it overrules the map, lift or clear
        the map and fit again; if it is tilted, level it and fit again. Return also the comparable
        cells (`ScanUpdate.fit`)."""
        scan_update, cells, motion = self._compare(scan, now)
        if motion is not None:
            self._record_offset(cells, motion)
        inconsistent, tested_cells = alignment.is_inconsistent(motion), cells
        is_narrow = scan_update.is_comparable and cells.shape[1] <= alignment.NARROW_CELLS
        if is_narrow and not inconsistent:
            tested_cells = scan_update.fit_finest()
            inconsistent = alignment.is_inconsistent_narrow(tested_cells, self._length_unit)
        verdict = self._rejected.decide(tested_cells, inconsistent)
        if verdict is Verdict.OVERRULES:
            height = float(np.median(tested_cells[update.RISE]))
            self._pending_offset = 0.0
            cells[update.RISE] -= height
            if alignment.is_inconsistent(self._rigid_motion(cells, scan, now)):
                self.leaves.reset()
                self._view = None
            else:
                alignment.lift_map(self.leaves, height, -np.inf)
            self._held = HeldReturns(self.domain)
            scan_update, cells, _ = self._compare(scan, now)
            self._recent_offsets.clear()
        elif verdict is Verdict.ACCEPTED and motion and motion.sigmas > alignment.JUMP_SIGMAS:
            alignment.remove_tilt(scan.points, motion)
            scan_update, cells, _ = self._compare(scan, now)
        return scan_update, cells, verdict

    def _compare(
        self, scan: RegisteredScan, now: float
    ) -> tuple[ScanUpdate, Array, RigidMotion | None]:
        """Fit a scan to the leaves; return the update, the comparable cells and their motion."""
        scan_update = ScanUpdate(self.leaves, self._rules, scan, now, self._buffers)
        cells = scan_update.fit()
        motion = self._rigid_motion(cells, scan, now) if scan_update.is_comparable else None
        return scan_update, cells, motion

    def _rigid_motion(self, cells: Array, scan: RegisteredScan, now: float) -> RigidMotion | None:
        motion: RigidMotion | None = alignment.rigid_motion(
            cells, scan.pose.covariance, now, self._correlation_time, self._length_unit
        )
        return motion

    def _record_offset(self, cells: Array, motion: RigidMotion) -> None:
        """Record the height of a scan over the map, accepted or not, for `unexplained_offset`."""
        values = [motion.height, motion.claimed, motion.mapped, motion.noise]
        if motion.share < alignment.AGREEING_SHARE:  # too few cells for a common height
            rows = [update.RISE, update.SCAN_VARIANCE, update.MAP_VARIANCE, update.NOISE_VARIANCE]
            values = np.median(cells[rows], axis=1).tolist()
        height, claimed, mapped, noise = values
        floor = alignment.FLOOR * self._length_unit**2
        self._recent_offsets.append((height**2, claimed + mapped, noise + floor))

    def _align(self, scan_update: ScanUpdate, cells: Array, now: float) -> float:
        """Remove the height offset between scan and map; return it, m."""
        cells[update.RISE] -= self._pending_offset
        offset: alignment.Offset | None = alignment.height_offset(
            cells, now, self._correlation_time, self._length_unit
        )
        if offset is None:
            return 0.0
        # Rounded: the order of the cells depends on where the square is, and results must not.
        scan_part, map_part = round(offset.scan_part, 9), round(offset.map_part, 9)
        self._pending_offset += map_part
        if abs(self._pending_offset) >= alignment.MIN_LIFT * self._length_unit:
            alignment.lift_map(self.leaves, self._pending_offset, round(offset.since, 9))
            self._held.lifted += self._pending_offset
            self._pending_offset = 0.0
        # The height over the map as it is now: offset.height is the sum of both parts.
        self._last_offset = (offset.height - map_part + self._pending_offset, offset.variance)
        scan_update.lower(scan_part + self._pending_offset)
        return offset.height

    def unexplained_offset(self) -> tuple[float, float] | None:
        """Return the median height of the last scans over or under the map, and the standard
        deviation that the poses claim for it, m; None if the claim explains it, or with too few
        scans."""
        if len(self._recent_offsets) < OFFSET_SCANS:
            return None
        square, claimed, other = np.median(np.array(self._recent_offsets), axis=0).tolist()
        if square <= OFFSET_SIGMAS**2 * (claimed + other):
            return None
        return math.sqrt(square), math.sqrt(claimed)

    def _update_noise_ratio(self, ratio: Array) -> None:
        """Update the running mean of observed over configured range noise by a scan's median over
        its points on level ground, which a smaller part of rough ground does not raise."""
        if ratio.shape[1] < NOISE_CELLS:
            return
        median = alignment.weighted_median(ratio[0], ratio[1])
        if math.isnan(self._noise_ratio):
            self._noise_ratio = median
        else:
            self._noise_ratio += NOISE_SHARE * (median - self._noise_ratio)

    def snapshot(self) -> CellMap:
        """Return a copy of the map."""
        rows, observed = self.leaves.rows_in_morton_order(), to_grid(self.leaves.observed)
        unobserved_covariance = np.empty((len(rows), 9))
        unobserved_parts(self.leaves, rows, unobserved_covariance)
        return CellMap(
            stamp_ns=self.stamp_ns,
            domain=self.domain,
            observed=observed >= OBSERVED,
            known=observed >= EXPLAINED,
            offset_z=self._last_offset[0],
            offset_variance=self._last_offset[1],
            **leaf_columns(self.leaves, rows, unobserved_covariance),
        )

    def _arrays(self) -> State:
        """Arrays of the state that keep their shape, not copies."""
        return {
            "observed": self.leaves.observed,
            "piled": self.leaves.piled,
            "hit_parts": self.leaves.hit_parts,
            "held_height": self._held.height,
            "held_scan": self._held.scan,
            "held_shown": self._held.shown,
        }

    def export_state(self) -> State:
        """Return copies of the state that a checkpoint keeps, by name (`tree.checkpoint`)."""
        return {
            "format": np.array(checkpoint.FORMAT),
            "domain": np.array(astuple(self.domain), dtype=np.float64),
            "leaves": np.array(self.leaves.rows[: self.leaves.count]),
            **{name: array.copy() for name, array in self._arrays().items()},
            "held_scans": np.array(self._held.scans),
            "held_lifted": np.array(self._held.lifted),
            "stamp_ns": np.array(self.stamp_ns),
            "start_ns": np.array(self._start_ns),
            "noise_ratio": np.array(self._noise_ratio),
            "last_offset": np.array(self._last_offset),
            "rejected_scans": np.array(astuple(self._rejected), dtype=np.float64),
            "pending_offset": np.array(self._pending_offset),
        }

    def import_state(self, state: State) -> None:
        """Continue from `export_state` of a mapper of the same domain, or, if it follows, of one
        that was moved. Raises `CheckpointError`: the state is invalid; the mapper is unchanged."""
        like, follows = self.export_state(), self.config.domain.follow != "none"
        most = self.config.mapping.max_cells
        domain = checkpoint.check(state, like, self.domain, most, follows=follows)
        self.reset()
        self.leaves.set_domain(domain)
        self.leaves.set_leaves(state["leaves"])
        for name, array in self._arrays().items():
            array[:] = state[name]
        self._held.scans = int(state["held_scans"])
        self._held.lifted = float(state["held_lifted"])
        self.stamp_ns = int(state["stamp_ns"])
        self._start_ns = int(state["start_ns"])
        self._noise_ratio = float(state["noise_ratio"])
        self._last_offset = tuple(state["last_offset"].tolist())
        self._pending_offset = float(state["pending_offset"])
        count, *last = state["rejected_scans"].tolist()
        self._rejected = RejectedScans(int(count), *last)


def _check_arguments(points: Points, pose: Pose) -> None:
    if not isinstance(pose, Pose):
        kind = type(pose).__name__
        raise TypeError(f"pose is of type {kind}; Pose.from_matrix(matrix, stamp_ns) makes one")
    if np.ndim(points) not in (2, 3) or np.shape(points)[-1] != 3:
        raise ValueError(f"points_lidar has shape {np.shape(points)}, not (N, 3) or (H, W, 3)")
