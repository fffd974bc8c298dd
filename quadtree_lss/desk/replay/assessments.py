# SPDX-License-Identifier: Apache-2.0
"""Maps and landing assessments at times of a bag, as the nodes make them, and their history."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from math import hypot, inf
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.landing.hazards import UNSEEN
from quadtree_lss.onboard.core.landing.result import LandingAssessment
from quadtree_lss.onboard.core.landing.target import State
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.intake import ReadyScan
from quadtree_lss.onboard.messages.maps import round_trip

ROUNDING = 1e-6
"""Rounding error of grid points when the domain follows the vehicle, m."""
FINAL_ASSESSMENTS = 4
"""Number of assessments of the last map after which the target no longer changes."""
MAX_ASSESSMENTS, MAX_SCANS = 240, 4000
"""Limits of the numbers of assessments and scans that are kept."""
DECADES, STEPS = 4.0, 60.0
"""The risk r is stored as -STEPS * log10(r), limited to 10^-DECADES <= r: with 4 % resolution."""
_POINT_STEP = 16  # every n-th point of a scan is used for its outline
_ANGLES = np.arange(12) * (2.0 * np.pi / 12)
_DIRECTIONS = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])


class TargetChange(NamedTuple):
    """A row of ``selected.csv``: a new target, or none (``id`` 0, position NaN). ``probability``:
    as in ``landing/status``."""

    stamp_ns: int
    id: int
    x: float
    y: float
    z: float
    probability: float
    reason: str

    @classmethod
    def of(cls, found: LandingAssessment) -> TargetChange:
        target, (x, y, z) = found.selected, found.selected.position.tolist()
        return cls(found.stamp_ns, target.id, x, y, z, target.probability, target.reason.key)

    def differs_from(self, last: TargetChange | None) -> bool:
        """Return whether the target is another one than the last, has moved, or was withdrawn."""
        if last is None or not last.id:
            return self.id > 0
        return self.id != last.id or hypot(self.x - last.x, self.y - last.y) >= ROUNDING


class Assessments:
    """Makes maps at most at ``publish.rate`` and assessments at most at ``publish.lss_rate`` in
    the bag's time, and always those of the last state.

    ``restrictions`` returns the keyword arguments of ``LandingSiteSelector.assess``. ``on_map``:
    callbacks with the bag's time and a function that returns the map during the call;
    ``on_assessment``: callbacks with the time and the assessment. ``cells``: last map as
    ``lss_node`` decodes it; ``last``: last assessment; ``changes``: of the target.
    """

    def __init__(self, config: Config, restrictions: Callable[[], dict[str, Any]]) -> None:
        self._restrictions = restrictions
        self.on_map: list[Callable[[int, Callable[[], CellMap]], None]] = []
        self.on_assessment: list[Callable[[int, LandingAssessment], None]] = []
        self._selector = LandingSiteSelector(config)
        self._map = _RateLimit(config.publish.rate)
        self._landing = _RateLimit(config.publish.lss_rate)
        self._snapshot: Callable[[], CellMap] | None = None
        self.cells: CellMap | None = None
        self.last: LandingAssessment | None = None
        self.lss_ms = float("nan")
        self._first_map_ns: int | None = None
        self._settle_time = config.lss.settle_time
        self.changes: list[TargetChange] = []

    def changed(self) -> None:
        """Note that the map changed."""
        self._map.changed = True

    def landing_changed(self) -> None:
        """Note that ``restrictions`` changed."""
        self._landing.changed = True

    def land_now(self) -> None:
        """Assess at once and select a target without waiting."""
        self._selector.land_now()
        self._landing.changed, self._landing.due_ns = True, 0

    def tick(self, now_ns: int, snapshot: Callable[[], CellMap]) -> None:
        """Make the map and the assessment if they are due."""
        if self._map.due(now_ns):
            self._make_map(now_ns, snapshot)
        self._landing.changed |= self._settling and self._waited(now_ns) >= self._settle_time
        if self._landing.due(now_ns):
            self._assess(now_ns)

    def finish(
        self, now_ns: int, snapshot: Callable[[], CellMap]
    ) -> tuple[CellMap, LandingAssessment]:
        """Make the map and the assessment of the last state, due or not, and return them."""
        if self._map.changed or self._snapshot is None:
            self._make_map(now_ns, snapshot)
        for _ in range(FINAL_ASSESSMENTS):
            if self._landing.changed or self._settling:
                self._assess(now_ns, waited=inf)
        assert self.cells is not None and self.last is not None
        return self.cells, self.last

    @property
    def _settling(self) -> bool:
        return self.last is not None and self.last.selected.state == State.SETTLING

    def _waited(self, now_ns: int) -> float:
        """Time since the first map, s."""
        return 0.0 if self._first_map_ns is None else 1e-9 * (now_ns - self._first_map_ns)

    def _make_map(self, now_ns: int, snapshot: Callable[[], CellMap]) -> None:
        """Prepare a map; it is made when it is used, because a newer one may replace it."""
        self._map.sent(now_ns)
        first_ns = self._first_map_ns
        if first_ns is None or now_ns < first_ns:  # the recorder's clock stepped back
            self._first_map_ns = now_ns
        self._snapshot, self.cells = cache(snapshot), None
        self._landing.changed = True
        if self._landing.due_ns < self._map.due_ns:
            self._snapshot()
        for callback in self.on_map:
            callback(now_ns, self._snapshot)

    def _assess(self, now_ns: int, waited: float | None = None) -> None:
        self._landing.sent(now_ns)
        if self._snapshot is None:
            return
        if self.cells is None:
            self.cells = round_trip(self._snapshot())
        began = time.perf_counter()
        waited = self._waited(now_ns) if waited is None else waited
        found = self._selector.assess(self.cells, waited=waited, **self._restrictions())
        self.lss_ms = 1e3 * (time.perf_counter() - began)
        row = TargetChange.of(found)
        if row.differs_from(self.changes[-1] if self.changes else None):
            self.changes.append(row)
        self.last, self._landing.changed = found, found.pending
        for callback in self.on_assessment:
            callback(now_ns, found)


class _RateLimit:
    """Limits the rate (Hz) of outputs after changes."""

    def __init__(self, rate: float) -> None:
        self._period_ns = round(1e9 / rate)
        self.due_ns = 0
        self.changed = False

    def due(self, now_ns: int) -> bool:
        # A due time more than a period ahead dates from before the recorder's clock stepped back.
        return self.changed and not self.due_ns - self._period_ns <= now_ns < self.due_ns

    def sent(self, now_ns: int) -> None:
        self.changed = False
        self.due_ns = now_ns + self._period_ns


class Thinned:
    """List of at most ``limit`` items, evenly spaced, and the last one."""

    def __init__(self, limit: int) -> None:
        self._limit, self._step, self._count = limit, 1, 0
        self._kept: list[Any] = []
        self._last: list[Any] = []

    def add(self, item: Any) -> None:
        if self._count % self._step == 0 and len(self._kept) == self._limit:
            self._kept, self._step = self._kept[::2], 2 * self._step
        keep = self._count % self._step == 0
        self._kept += [item] * keep
        self._last = [] if keep else [item]
        self._count += 1

    def all(self) -> list[Any]:
        return [*self._kept, *self._last]


class History:
    """Records assessments, lidar positions and outlines of scans for ``history.npz``."""

    def __init__(self) -> None:
        self._answers, self._scans = Thinned(MAX_ASSESSMENTS), Thinned(MAX_SCANS)

    def landing(self, now_ns: int, found: LandingAssessment) -> None:
        sites = found.sites
        ranked = sites.id, sites.position, sites.score, sites.probability
        seen = found.hazard & UNSEEN == 0
        risk = np.where(seen, found.risk, np.nan)
        stored = np.rint(-STEPS * np.log10(np.maximum(risk, 10.0**-DECADES)))
        self._answers.add(
            {
                "stamp_ns": found.stamp_ns,
                "corner": (found.x[0], found.y[0]),
                "seen": np.packbits(seen),
                "allowed": np.packbits(found.safe),
                "risk": np.nan_to_num(stored, nan=255.0).astype(np.uint8).ravel(),
                "sites": np.column_stack(ranked),
                "target": np.array(TargetChange.of(found)[1:6]),
                "target_why": found.why,
            }
        )

    def scan(self, scan: ReadyScan) -> None:
        points = scan.points_lidar.reshape(-1, 3)[::_POINT_STEP]
        ground = points @ scan.pose.rotation_map_lidar[:2].T + scan.pose.position[:2]
        ground = ground[np.isfinite(ground[:, 0]) & np.isfinite(ground[:, 1])]
        if not len(ground):
            ground = np.full((1, 2), np.nan)
        outline = ground[(ground @ _DIRECTIONS.T).argmax(axis=0)]
        self._scans.add((scan.stamp_ns, scan.pose.position.copy(), outline))

    def arrays(self, *, risk: bool = True) -> dict[str, NDArray[Any]]:
        """Return the content of the file, map frame, m. ``risk``: include the risk of each grid
        point, which is most of the file."""
        scans, answers = self._scans.all(), self._answers.all()
        sites = np.concatenate([a["sites"] for a in answers]) if answers else np.zeros((0, 6))
        outlines = np.array([outline for _, _, outline in scans])

        def column(name: str, kind: type | None = None) -> NDArray[Any]:
            return np.array([answer[name] for answer in answers], kind)

        return {
            "scan_stamp_ns": np.array([stamp for stamp, _, _ in scans], dtype=np.int64),
            "scan_position": np.array([position for _, position, _ in scans]).reshape(-1, 3),
            "scan_outline": outlines.reshape(-1, len(_DIRECTIONS), 2),
            "answer_stamp_ns": column("stamp_ns", np.int64),
            "answer_corner": column("corner").reshape(-1, 2),
            "seen": column("seen", np.uint8),
            "allowed": column("allowed", np.uint8),
            **({"risk": column("risk")} if risk else {}),
            "target": column("target").reshape(-1, 5),
            "target_why": column("target_why", str),
            "site_answer": np.repeat(np.arange(len(answers)), [len(a["sites"]) for a in answers]),
            "site_id": sites[:, 0].astype(np.int64),
            "site_position": sites[:, 1:4],
            "site_score": sites[:, 4],
            "site_probability": sites[:, 5],
        }
