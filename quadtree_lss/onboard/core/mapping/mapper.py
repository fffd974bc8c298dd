# SPDX-License-Identifier: Apache-2.0
"""The map: what one scan does to it (paper IV)."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array, Points
from quadtree_lss.onboard.config.settings import DEFAULTS, Config
from quadtree_lss.onboard.core.mapping.alignment import (
    JUMP,
    LEAST_LIFT,
    Offset,
    lift,
    lower,
    offset_of,
    weighted_median,
)
from quadtree_lss.onboard.core.mapping.contradiction import (
    AGREEING,
    DEVIATIONS,
    NARROW,
    SHARE,
    SMOOTH,
    Contradiction,
    Verdict,
    departs,
    stands_apart,
)
from quadtree_lss.onboard.core.mapping.departure import FLOOR, Departure, departure
from quadtree_lss.onboard.core.mapping.measure import Rules, unseen_parts
from quadtree_lss.onboard.core.mapping.update import (
    OF_MAP,
    OF_SCAN,
    OWN,
    RISE,
    Room,
    ScanUpdate,
)
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.pose_buffer import SECOND_NS
from quadtree_lss.onboard.core.sensing.register import RegisteredScan, register
from quadtree_lss.onboard.core.sensing.sweep import Sweep
from quadtree_lss.onboard.core.tree import checkpoint
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.checkpoint import State
from quadtree_lss.onboard.core.tree.columns import leaf_columns
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.held_returns import HeldReturns
from quadtree_lss.onboard.core.tree.leaves import LeafTable, unfold

#: A scan older than the map by more than this is no late one: time jumped back (`ScanQueue`).
JUMP_NS = SECOND_NS
#: Cells that a scan must have to tell the range noise.
NOISE_CELLS = 3
#: Share of a new scan in the running mean of the observed range noise.
NOISE_SHARE = 0.1
#: Last scans of which `Mapper.pose_gap` takes the median.
GAP_SCANS = 20
#: Standard deviations from which on heights contradict the poses' covariances. Of Gaussian errors 3
#: in 1,000 exceed them; half of `GAP_SCANS` scans do so only if the errors are 4.5 times the claim.
GAP_SIGMAS = 3.0


@dataclass(frozen=True)
class ScanReport:
    """What became of one scan.

    Attributes:
        stamp_ns: The scan's stamp.
        points: Points in the message.
        points_used: Points of the scan that entered the map; with ``dropped`` they are all points.
        dropped: Points that were unsound or outside, by reason (``sensing.register``), or all the
            others as ``contradiction``: the scan was refused. ``isolated`` are also those held
            back, which may enter with a later scan.
        admitted: Isolated returns of earlier scans that entered with this one, because it is
            the third to show their places. They count as ``isolated`` in the report of their own
            scan, and in ``points`` of no other.
        leaves: Leaves after the scan.
        divisions: Cells divided by it.
        refused_divisions: Cells that ``mapping.max_cells`` left whole.
        noise_ratio: Observed over configured range noise (running mean of the scans' medians), NaN
            if unknown.
        centre: x and y of the middle of the sound returns, map frame, m, if all were outside the
            domain; else None.
        offset: By how much the scan's ground lay over the map's by its pose, m; 0 where that was
            not compared.
        overruled: Whether the map was lifted to the scan, or forgotten, because the last scans
            contradicted it and agreed with each other.
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
    """Keeps the quadtree; ``update`` takes a scan and its pose, ``snapshot`` gives the map.

    Not thread-safe. A scan either enters whole or, if none of its points is sound or it contradicts
    the map, changes nothing. With ``domain.follow`` the square is then moved, if what it follows is
    no longer near its middle (`Domain.steps_to`); scans that no point entered of move it only as
    the tenth in a row, so that a wrong pose does not drop the map. ``stamp_ns`` is that of the
    newest scan since time last jumped back (a looping bag, a clock set right; leaves may then be of
    later stamps), 0 if nothing is mapped.
    """

    def __init__(self, config: Config = DEFAULTS) -> None:
        self.config = config
        self.leaves = LeafTable(Domain.of(config.domain), config.mapping.max_cells)
        self._area: tuple[float, float] | None = None
        self._rules = Rules(config)
        self._room = Room()
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
        """The square as it lies now."""
        domain: Domain = self.leaves.domain
        return domain

    def look_at(self, area: ArrayLike | None) -> None:
        """The landing area (V, 2), m, or None for none: where ``domain.follow: area`` goes to, with
        the next scan. Raises `ValueError`: it is asked for, and is no polygon."""
        self._area = None
        if area is not None and self.config.domain.follow == "area":
            corners = np.asarray(area, dtype=np.float64).reshape(-1, 2)
            x, y = (0.5 * (corners.min(axis=0) + corners.max(axis=0))).tolist()
            self._area = x, y

    def reset(self) -> None:
        """Forget everything that was mapped."""
        self.leaves.plant()
        self._held.clear()
        self.stamp_ns = 0
        self._start_ns = 0
        self._noise_ratio = float("nan")
        self._offset = (float("nan"), float("nan"))
        self._against = Contradiction()
        # Lift of the map that is due and too small to be done yet, m.
        self._owed = 0.0
        # Scans in a row of which no point entered the map.
        self._missed = 0
        # Of the last scans compared with the map: squared height over it, and its variance from the
        # claimed pose errors and from anything else, m^2.
        self._gaps: deque[tuple[float, float, float]] = deque(maxlen=GAP_SCANS)

    def update(self, points_lidar: Points, pose: Pose, sweep: Sweep | None = None) -> ScanReport:
        """Map one scan of points (H, W, 3) organised or (N, 3), lidar axes (z boresight), m, of
        which rows that are not finite are no returns, from the lidar's pose at its stamp; ``sweep``
        is how the lidar moved while it took the scan, None if at once. Raises `TypeError`: the pose
        is no `Pose`; `ValueError`: the points have another shape."""
        if not isinstance(pose, Pose):
            kind = type(pose).__name__
            raise TypeError(f"pose is of type {kind}; Pose.from_matrix(matrix, stamp_ns) makes one")
        if np.ndim(points_lidar) not in (2, 3) or np.shape(points_lidar)[-1] != 3:
            shape = np.shape(points_lidar)
            raise ValueError(f"points_lidar has shape {shape}; it needs (N, 3) or (H, W, 3)")
        if not self.stamp_ns or self.config.domain.follow == "area":
            self._follow(pose)  # there is nothing to drop yet, or no pose decides
        if pose.stamp_ns < self.stamp_ns - JUMP_NS:
            self._held.clear()  # time jumped back
        lidar = self.config.lidar
        scan, dropped = register(points_lidar, pose, lidar, self.domain, sweep, self._held)
        used = len(scan.key) - scan.admitted
        divisions = refused = 0
        offset, verdict = 0.0, Verdict.SOUND
        if used:
            now = 1e-9 * (pose.stamp_ns - (self._start_ns or pose.stamp_ns))
            change, cells, verdict = self._confront(scan, now)
            if verdict is Verdict.REFUSED:
                dropped["contradiction"], used = used, 0
                offset = self._against.height
            else:
                if not self.stamp_ns - JUMP_NS <= pose.stamp_ns <= self.stamp_ns:
                    self.stamp_ns = pose.stamp_ns
                self._start_ns = self._start_ns or pose.stamp_ns
                if not self.config.mapping.by_paper("covariance"):
                    offset = self._align(change, cells, now)
                change.settle()
                self._check_noise(change.ratio)
                divisions, refused = change.divisions, change.refused
        if verdict is not Verdict.REFUSED and "above" not in dropped:
            self._held.keep(scan.isolated if verdict is Verdict.SOUND else None)
        self._missed = 0 if used else self._missed + 1
        if used or self._missed >= AGREEING:
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

    def _follow(self, pose: Pose) -> None:
        """Move the square after what it follows."""
        if self.config.domain.follow == "none":
            return
        at = self._area if self.config.domain.follow == "area" else pose.position[:2].tolist()
        if at is not None:
            east, north = self.domain.steps_to(*at)
            if east or north:
                self.leaves.follow(east, north)
                cells = 1 << (self.domain.max_level - self.domain.min_level)
                self._held.follow(east * cells, north * cells)

    def _confront(self, scan: RegisteredScan, now: float) -> tuple[ScanUpdate, Array, Verdict]:
        """A scan fitted to the leaves, how it compares with them, and what is to become of it.

        Where it overrules the map, that is put right.
        """
        change, cells, found = self._compare(scan, now)
        compared, contradicts = cells, departs(found)
        if found is not None:
            self._note_gap(cells, found)
        smooth = change.compared > SMOOTH * change.estimated
        if not contradicts and smooth and cells.shape[1] <= NARROW:
            compared = change.parts()
            contradicts = stands_apart(compared, self.config.vehicle.height)
        verdict = self._against.judge(compared, contradicts)
        if verdict is Verdict.OVERRULES:
            height = float(np.median(compared[RISE]))
            self._owed = 0.0
            cells[RISE] -= height
            if departs(self._departure(scan, cells, now)):
                self.leaves.plant()
            else:
                lift(self.leaves, height, -np.inf)
            self._held.clear()  # the map lies elsewhere than was compared
            change, cells, found = self._compare(scan, now)
            self._gaps.clear()
        elif found is not None and found.deviations > JUMP and verdict is Verdict.SOUND:
            lower(scan.points, found)
            change, cells, found = self._compare(scan, now)
        return change, cells, verdict

    def _compare(
        self, scan: RegisteredScan, now: float
    ) -> tuple[ScanUpdate, Array, Departure | None]:
        """A scan fitted to the leaves, its cells beside the map's, and what they have in common."""
        change = ScanUpdate(self.leaves, self._rules, scan, now, self._room)
        cells = change.fit()
        if change.compared < SMOOTH * change.estimated:
            return change, cells, None
        return change, cells, self._departure(scan, cells, now)

    def _note_gap(self, cells: Array, found: Departure) -> None:
        """Remember how far a scan, rejected or not, lay from the map, for `pose_gap`."""
        values = [found.height, found.claimed, found.mapped, found.noise]
        if found.share < SHARE:  # too few cells agree to give a common height
            values = np.median(cells[[RISE, OF_SCAN, OF_MAP, OWN]], axis=1).tolist()
        height, claimed, mapped, noise = values
        floor = FLOOR * self.config.vehicle.height**2
        self._gaps.append((height**2, claimed + mapped, noise + floor))

    def _departure(self, scan: RegisteredScan, cells: Array, now: float) -> Departure | None:
        time = self.config.pose.correlation_time
        found: Departure | None = departure(
            cells, scan.pose.covariance, now, time, DEVIATIONS, self.config.vehicle.height
        )
        return found

    def _align(self, change: ScanUpdate, cells: Array, now: float) -> float:
        """Let the scan and the map meet at one height; by how much it lay over the map, m.
        ``change``: the scan. ``cells``: of `ScanUpdate.fit`. ``now``: time of the scan, s."""
        cells[RISE] -= self._owed
        time, metre = self.config.pose.correlation_time, self.config.vehicle.height
        offset: Offset | None = offset_of(cells, now, time, metre)
        if offset is None:
            return 0.0
        # Cells are summed up in an order that follows from where the square lies: it is to change
        # no bit.
        of_scan, of_map = round(offset.scan, 9), round(offset.map, 9)
        self._owed += of_map
        if abs(self._owed) >= LEAST_LIFT * metre:
            lift(self.leaves, self._owed, round(offset.since, 9))
            self._held.lifted += self._owed
            self._owed = 0.0
        self._offset = (offset.height - of_map + self._owed, offset.variance)
        change.align(of_scan + self._owed)
        return offset.height

    def pose_gap(self) -> tuple[float, float] | None:
        """By how much the last scans and the map differ in height and the standard deviation that
        their poses claim of that, m; None if the claim explains it or it is not known yet."""
        if len(self._gaps) < GAP_SCANS:
            return None
        square, claimed, other = np.median(np.array(self._gaps), axis=0).tolist()
        if square <= GAP_SIGMAS**2 * (claimed + other):
            return None
        return math.sqrt(square), math.sqrt(claimed)

    def _check_noise(self, ratio: Array) -> None:
        """Running mean of observed over configured range noise.

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
        """The map as it stands; copies, so that later scans do not change it."""
        rows, n = self.leaves.in_order(), self.domain.finest_count
        observed, range_part = np.empty((n, n), dtype=np.uint8), np.empty((len(rows), 9))
        unfold(self.leaves.observed, observed)
        unseen_parts(self.leaves, rows, range_part)
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
            "against": np.array(astuple(self._against), dtype=np.float64),
            "owed": np.array(self._owed),
        }
        return checkpoint.identified(state, self.domain)

    def import_state(self, state: State) -> None:
        """Go on from `export_state` of a mapper of the same domain, or, if it follows, of one that
        was moved. Raises `CheckpointError`: it is none; the mapper is then unchanged."""
        like, follows = self.export_state(), self.config.domain.follow != "none"
        most = self.config.mapping.max_cells
        domain = checkpoint.check(state, like, self.domain, most, follows=follows)
        leaves = state["leaves"]
        self.leaves.lie_on(domain)
        self.leaves.take_up({name: leaves[name] for name in leaves.dtype.names or ()})
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
        self._owed = float(state["owed"])
        self._missed = 0
        self._gaps.clear()
        count, height, variance = state["against"].tolist()
        self._against = Contradiction(int(count), height, variance)
