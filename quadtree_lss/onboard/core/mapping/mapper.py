# SPDX-License-Identifier: Apache-2.0
"""Mapping of scans into the quadtree (paper IV)."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array, Points, keep_memory
from quadtree_lss.onboard.config.settings import DEFAULTS, Config
from quadtree_lss.onboard.core.mapping.alignment import (
    AGREEING_SHARE,
    COMPARABLE_SHARE,
    FLOOR,
    JUMP_SIGMAS,
    MIN_LIFT,
    NARROW_CELLS,
    OVERRULING_SCANS,
    Motion,
    Offset,
    RejectedScans,
    Verdict,
    height_offset,
    is_inconsistent,
    is_inconsistent_narrow,
    lift_map,
    remove_tilt,
    rigid_motion,
    weighted_median,
)
from quadtree_lss.onboard.core.mapping.measure import Rules, unobserved_parts
from quadtree_lss.onboard.core.mapping.update import (
    OF_MAP,
    OF_SCAN,
    OWN,
    RISE,
    ScanBuffers,
    ScanUpdate,
)
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.pose_buffer import JUMP_NS
from quadtree_lss.onboard.core.sensing.register import RegisteredScan, register
from quadtree_lss.onboard.core.sensing.sweep import Sweep
from quadtree_lss.onboard.core.tree import checkpoint
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.checkpoint import State
from quadtree_lss.onboard.core.tree.columns import leaf_columns
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.held_returns import HeldReturns
from quadtree_lss.onboard.core.tree.leaves import LeafTable, to_grid

#: Least number of cells of a scan for an estimate of the range noise.
NOISE_CELLS = 3
#: Share of a new scan in the running mean of the observed range noise.
NOISE_SHARE = 0.1
#: Number of scans in the median of `Mapper.pose_gap`.
GAP_SCANS = 20
#: Heights that exceed so many standard deviations contradict the covariances of the poses: 3 in
#: 1,000 Gaussian errors do. Half of `GAP_SCANS` scans do only if the errors are 4.5 times the
#: claim.
GAP_SIGMAS = 3.0


@dataclass(frozen=True)
class ScanReport:
    """Result of mapping one scan.

    Attributes:
        stamp_ns: The scan's stamp. points: Points in the message. points_used: Points of the scan
        that entered the map. With ``dropped``, they are all points. dropped: Number of dropped
        points by reason (``sensing.register``); ``contradiction`` for all points of a rejected
        scan. ``isolated`` ones are held back and may enter later.
        leaves: Leaves after the scan. divisions: Cells that the scan divided. refused_divisions:
        Cells that ``mapping.max_cells`` left undivided. noise_ratio: Observed over configured range
        noise (running mean of the medians of scans), NaN if unknown.
        centre: If all returns are outside the domain: x and y of their mean, map frame, m. offset:
        Height of the scan's ground over the map's, by its pose, m; 0 if not compared. overruled:
        Whether this scan lifted or restarted the map, because the last scans contradicted it and
        agreed with each other.
        admitted: Isolated returns of earlier scans that entered with this one, because it is the
            third to show their places; ``isolated`` in the reports of their own scans.
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

    Not thread-safe. A scan enters as a whole, or changes nothing if none of its points is usable or
    it contradicts the map. With ``domain.follow`` the square then moves, if the followed point left
    its middle (`Domain.steps_to`). Scans without a mapped point move it only after
    `OVERRULING_SCANS` in a row, so that a wrong pose does not discard the map.

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
        self._buffers = ScanBuffers()
        self._held = HeldReturns(self.domain)
        self.reset()

    def __repr__(self) -> str:
        d = self.domain
        return (
            f"<Mapper: {self.leaves.count} leaves on {d.size:g} x {d.size:g} m;"
            f" newest scan at {self.stamp_ns} ns>"
        )

    @property
    def domain(self) -> Domain:
        """Current square of the map."""
        domain: Domain = self.leaves.domain
        return domain

    def look_at(self, area: ArrayLike | None) -> None:
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
        self._held.clear()
        self.stamp_ns = 0
        self._start_ns = 0
        self._noise_ratio = float("nan")
        self._offset = (float("nan"), float("nan"))
        self._rejected = RejectedScans()
        # Lift of the map that is known and too small to be applied yet, m.
        self._pending_offset = 0.0
        # Consecutive scans without a mapped point.
        self._unmapped_scans = 0
        # For the last scans: squared height over the map, its variance from the claimed pose
        # errors, and from other causes, m^2.
        self._gaps: deque[tuple[float, float, float]] = deque(maxlen=GAP_SCANS)

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
            self._follow(pose)  # nothing can be lost, or the pose does not decide
        if pose.stamp_ns < self.stamp_ns - JUMP_NS:
            self._held.clear()
        lidar = self.config.lidar
        # Register the points and order them by their finest cells.
        scan, dropped = register(points_lidar, pose, lidar, self.domain, sweep, self._held)
        used, offset, verdict = len(scan.key) - scan.admitted, 0.0, Verdict.ACCEPTED
        divisions = refused = 0
        if used:
            now = 1e-9 * (pose.stamp_ns - (self._start_ns or pose.stamp_ns))
            # Fit the touched leaves, and decide by their height and tilt over the map.
            change, cells, verdict = self._compare_and_decide(scan, now)
            if verdict is Verdict.REJECTED:
                dropped["contradiction"], used, offset = used, 0, self._rejected.height
            else:
                self._note_time(pose.stamp_ns)
                if not self.config.mapping.by_paper("covariance"):
                    offset = self._align(change, cells, now)
                # Fuse the fits; divide leaves where the plane does not suffice.
                change.update_leaves()
                self._update_noise_ratio(change.ratio)
                divisions, refused = change.divisions, change.refused
        if verdict is not Verdict.REJECTED and "above" not in dropped:
            self._held.keep(scan.isolated if verdict is Verdict.ACCEPTED else None)
        self._unmapped_scans = 0 if used else self._unmapped_scans + 1
        if used or self._unmapped_scans >= OVERRULING_SCANS:
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

    def _note_time(self, stamp_ns: int) -> None:
        """Advance the map's stamp, or set it back if time jumped back."""
        if not self.stamp_ns - JUMP_NS <= stamp_ns <= self.stamp_ns:
            self.stamp_ns = stamp_ns
        self._start_ns = self._start_ns or stamp_ns

    def _follow(self, pose: Pose) -> None:
        """Move the square towards the followed point."""
        if self.config.domain.follow == "none":
            return
        at = self._area if self.config.domain.follow == "area" else pose.position[:2].tolist()
        if at is not None:
            east, north = self.domain.steps_to(*at)
            if east or north:
                self.leaves.follow(east, north)
                cells = 1 << (self.domain.max_level - self.domain.min_level)
                self._held.follow(east * cells, north * cells)

    def _compare_and_decide(
        self, scan: RegisteredScan, now: float
    ) -> tuple[ScanUpdate, Array, Verdict]:
        """Fit a scan to the leaves and accept, reject or overrule; apply the decision to the map or
        to the tilt of the scan.

        Returns the update, the compared cells (`ScanUpdate.fit`) and the decision.
        """
        change, cells, motion = self._compare(scan, now)
        compared, inconsistent = cells, is_inconsistent(motion)
        if motion is not None:
            self._record_gap(cells, motion)
        comparable = change.compared > COMPARABLE_SHARE * change.estimated
        if not inconsistent and comparable and cells.shape[1] <= NARROW_CELLS:
            compared = change.fit_finest()
            inconsistent = is_inconsistent_narrow(compared, self.config.vehicle.clearance_ratio)
        verdict = self._rejected.decide(compared, inconsistent)
        if verdict is Verdict.OVERRULES:
            height = float(np.median(compared[RISE]))
            self._pending_offset = 0.0
            cells[RISE] -= height
            if is_inconsistent(self._motion(scan, cells, now)):
                self.leaves.reset()
            else:
                lift_map(self.leaves, height, -np.inf)
            self._held.clear()
            change, cells, _ = self._compare(scan, now)
            self._gaps.clear()
        elif verdict is Verdict.ACCEPTED and motion is not None and motion.sigmas > JUMP_SIGMAS:
            remove_tilt(scan.points, motion)
            change, cells, _ = self._compare(scan, now)
        return change, cells, verdict

    def _compare(self, scan: RegisteredScan, now: float) -> tuple[ScanUpdate, Array, Motion | None]:
        """Fit a scan to the leaves; return the update, the compared cells and their motion."""
        change = ScanUpdate(self.leaves, self._rules, scan, now, self._buffers)
        cells = change.fit()
        if change.compared < COMPARABLE_SHARE * change.estimated:
            return change, cells, None
        return change, cells, self._motion(scan, cells, now)

    def _motion(self, scan: RegisteredScan, cells: Array, now: float) -> Motion | None:
        time, height = self.config.pose.correlation_time, self.config.vehicle.clearance_ratio
        motion: Motion | None = rigid_motion(cells, scan.pose.covariance, now, time, height)
        return motion

    def _record_gap(self, cells: Array, motion: Motion) -> None:
        """Record the height of a scan over the map, accepted or not, for `pose_gap`."""
        values = [motion.height, motion.claimed, motion.mapped, motion.noise]
        if motion.share < AGREEING_SHARE:  # too few cells for a common height
            values = np.median(cells[[RISE, OF_SCAN, OF_MAP, OWN]], axis=1).tolist()
        height, claimed, mapped, noise = values
        floor = FLOOR * self.config.vehicle.clearance_ratio**2
        self._gaps.append((height**2, claimed + mapped, noise + floor))

    def _align(self, change: ScanUpdate, cells: Array, now: float) -> float:
        """Remove the height offset between scan and map; return it, m."""
        cells[RISE] -= self._pending_offset
        time, length_unit = self.config.pose.correlation_time, self.config.vehicle.clearance_ratio
        offset: Offset | None = height_offset(cells, now, time, length_unit)
        if offset is None:
            return 0.0
        # Rounded, because the order of the cells depends on where the square is, and results must
        # not.
        of_scan, of_map = round(offset.scan, 9), round(offset.map, 9)
        self._pending_offset += of_map
        if abs(self._pending_offset) >= MIN_LIFT * length_unit:
            lift_map(self.leaves, self._pending_offset, round(offset.since, 9))
            self._held.lifted += self._pending_offset
            self._pending_offset = 0.0
        self._offset = (offset.height - of_map + self._pending_offset, offset.variance)
        change.lower(of_scan + self._pending_offset)
        return offset.height

    def pose_gap(self) -> tuple[float, float] | None:
        """Return the height difference of the last scans and the map, and the standard deviation
        that the poses claim for it, m; None if the claim explains it, or with too few scans."""
        if len(self._gaps) < GAP_SCANS:
            return None
        square, claimed, other = np.median(np.array(self._gaps), axis=0).tolist()
        if square <= GAP_SIGMAS**2 * (claimed + other):
            return None
        return math.sqrt(square), math.sqrt(claimed)

    def _update_noise_ratio(self, ratio: Array) -> None:
        """Update the running mean of observed over configured range noise.

        Each scan gives the median over its points on level ground of the residual's standard
        deviation about their cell's own plane, over what the configured range noise makes of it.
        On planar ground that is one; rough ground raises some cells, not the median while most of
        the ground is smooth at the size of a leaf.
        """
        if ratio.shape[1] < NOISE_CELLS:
            return
        median = weighted_median(ratio[0], ratio[1])
        if math.isnan(self._noise_ratio):
            self._noise_ratio = median
        else:
            self._noise_ratio += NOISE_SHARE * (median - self._noise_ratio)

    def snapshot(self) -> CellMap:
        """Return a copy of the map."""
        rows, n = self.leaves.rows_in_morton_order(), self.domain.finest_count
        observed, range_part = np.empty((n, n), dtype=np.uint8), np.empty((len(rows), 9))
        to_grid(self.leaves.observed, observed)
        unobserved_parts(self.leaves, rows, range_part)
        return CellMap(
            stamp_ns=self.stamp_ns,
            domain=self.domain,
            observed=observed > 0,
            known=observed > 1,
            offset_z=self._offset[0],
            offset_variance=self._offset[1],
            **leaf_columns(self.leaves, rows, range_part),
        )

    def export_state(self) -> State:
        """All that a mapper must know to go on, by name; copies (see ``tree.checkpoint``)."""
        state = {
            "leaves": np.array(self.leaves.rows[: self.leaves.count]),
            "observed": self.leaves.observed.copy(),
            "piled": self.leaves.piled.copy(),
            "hit_parts": self.leaves.hit_parts.copy(),
            "held_height": self._held.height.copy(),
            "held_scan": self._held.scan.copy(),
            "held_shown": self._held.shown.copy(),
            "held_scans": np.array(self._held.scans),
            "held_lifted": np.array(self._held.lifted),
            "stamp_ns": np.array(self.stamp_ns),
            "start_ns": np.array(self._start_ns),
            "noise_ratio": np.array(self._noise_ratio),
            "offset": np.array(self._offset),
            "against": np.array(astuple(self._rejected), dtype=np.float64),
            "owed": np.array(self._pending_offset),
        }
        return checkpoint.identified(state, self.domain)

    def import_state(self, state: State) -> None:
        """Go on from `export_state` of a mapper of the same domain, or, if it follows, of one that
        was moved. Raises `CheckpointError`: it is none; the mapper is then unchanged."""
        like, follows = self.export_state(), self.config.domain.follow != "none"
        most = self.config.mapping.max_cells
        domain = checkpoint.check(state, like, self.domain, most, follows=follows)
        leaves = state["leaves"]
        self.leaves.set_domain(domain)
        self.leaves.set_leaves({name: leaves[name] for name in leaves.dtype.names or ()})
        self.leaves.observed[:] = state["observed"]
        self.leaves.piled[:] = state["piled"]
        self.leaves.hit_parts[:] = state["hit_parts"]
        self._held.height[:] = state["held_height"]
        self._held.scan[:] = state["held_scan"]
        self._held.shown[:] = state["held_shown"]
        self._held.scans = int(state["held_scans"])
        self._held.lifted = float(state["held_lifted"])
        self.stamp_ns = int(state["stamp_ns"])
        self._start_ns = int(state["start_ns"])
        self._noise_ratio = float(state["noise_ratio"])
        height, variance = state["offset"].tolist()
        self._offset = (height, variance)
        self._pending_offset = float(state["owed"])
        self._unmapped_scans = 0
        self._gaps.clear()
        count, height, variance = state["against"].tolist()
        self._rejected = RejectedScans(int(count), height, variance)


def _check_arguments(points: Points, pose: Pose) -> None:
    if not isinstance(pose, Pose):
        kind = type(pose).__name__
        raise TypeError(f"pose is of type {kind}; Pose.from_matrix(matrix, stamp_ns) makes one")
    if np.ndim(points) not in (2, 3) or np.shape(points)[-1] != 3:
        shape = np.shape(points)
        raise ValueError(f"points_lidar has shape {shape}; it needs (N, 3) or (H, W, 3)")
