# SPDX-License-Identifier: Apache-2.0
"""Both nodes in lock-step: what they do with each message, without transport, in the flight's time.

The functions are those that nodes and replay call: `Intake`, `Mapper`, `Passes`. A node that is
killed loses what it held in memory; what is latched comes back to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from quadtree_lss.desk.bags.message_types import typestore
from quadtree_lss.desk.replay.history import History
from quadtree_lss.desk.replay.passes import Passes, TargetChange
from quadtree_lss.lab.flight.flight import Sent
from quadtree_lss.lab.flight.pilot import Target
from quadtree_lss.lab.simulation.recording import Messages
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.assessment import LandingAssessment
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.mapping.prior_offset import PriorOffset
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.core.tree.prior import Prior
from quadtree_lss.onboard.messages.intake import Intake
from quadtree_lss.onboard.messages.landing_inputs import AREA, LandingWishes

REPEAT_NS = 400_000_000
"""``landing/selected`` is said again so often, as by lss_node."""


@dataclass
class _Assessments:
    """Sink of the passes: answers reach guidance after a delay."""

    delay_ns: int
    last: LandingAssessment | None = None
    at_ns: int = 0
    waiting: list[tuple[int, LandingAssessment]] = field(default_factory=list)

    def map(self, now_ns: int, take: Callable[[], CellMap]) -> None:
        """Nobody but lss_node hears it."""

    def landing(self, now_ns: int, found: LandingAssessment) -> None:
        self.waiting.append((now_ns + self.delay_ns, found))

    def due(self, now_ns: int) -> LandingAssessment | None:
        """What is said now: a new answer, or the last one again; None if nothing is."""
        if self.waiting and self.waiting[0][0] <= now_ns:
            self.last, self.at_ns = self.waiting.pop(0)[1], now_ns
            return self.last
        if self.last is not None and now_ns - self.at_ns >= REPEAT_NS:
            self.at_ns = now_ns
            return self.last
        return None


class LockstepNodes:
    """mapping_node and lss_node of one configuration without transport. ``answer_delay`` is from a
    pass to its answer at the guidance, s; ``last`` the last answer that reached it; ``history``
    notes all, ``targets`` are the changes of the target; ``prior`` is `Mapper`'s."""

    def __init__(
        self,
        config: Config,
        answer_delay: float,
        history: History | None = None,
        prior: Prior | None = None,
    ) -> None:
        self._config, self._prior = config, prior
        self._make = Messages(typestore(ros1=False).types, frame=config.frames.map)
        self._delay_ns = round(1e9 * answer_delay)
        self._wishes = LandingWishes(config.frames.map)
        self._checkpoint: Any = None
        self._checkpoint_ns = 0
        self._down: set[str] = set()
        self.last: LandingAssessment | None = None
        self.scans = 0
        self.history, self._noise_ratio = history, float("nan")
        self.targets: list[TargetChange] = []
        self._start_mapping()
        self._start_lss()

    def take(self, sent: Sent, now_ns: int) -> None:
        topic, message = sent.topic, sent.message(self._make)
        if topic == "nav/pose":
            self._wishes.navigation.take(message)
        if topic.startswith("landing/"):
            self._wishes.take(topic.removeprefix("landing/"), message)
            self._passes.landing_changed()
        elif "mapping" in self._down:
            return
        elif topic == "nav/pose":
            self._intake.on_pose(message)
        else:
            self._intake.on_cloud(message, now_ns)

    def work(self, now_ns: int) -> list[Target]:
        """Maps and assesses what is due; what ``landing/selected`` says now, if anything."""
        if "mapping" not in self._down:
            self._mapper.look_at(self._wishes.values[AREA])
            for scan in self._intake.ready(now_ns):
                report = self._mapper.update(scan.points_lidar, scan.pose, scan.sweep)
                self._noise_ratio = report.noise_ratio
                self.scans += 1
                if self.history is not None:
                    self.history.scan(scan)
                self._passes.changed()
            self._intake.notices()
            if now_ns - self._checkpoint_ns >= 1e9 * self._config.checkpoint.interval:
                self._checkpoint, self._checkpoint_ns = self._mapper.export_state(), now_ns
        if "lss" in self._down:
            return []
        self._passes.tick(now_ns, self._mapper.snapshot)
        said = self._assessments.due(now_ns)
        if said is None:
            return []
        self.last = said
        self._chosen = self._chosen or not said.undecided
        if not self._chosen:  # as lss_node, of which the one before may have named a target
            return []
        return [Target(said.selected.position.copy() if said.selected.id else None)]

    def land_now(self) -> None:
        self._passes.land_now()

    def finish(self, now_ns: int) -> tuple[CellMap | None, LandingAssessment | None]:
        """The map at the end, and what is found on it; of the landing wishes, the last."""
        self._passes.finish(now_ns, self._mapper.snapshot)
        return self._passes.cells, self._passes.last

    @property
    def told(self) -> dict[str, Any]:
        """What guidance said last, how the returns scatter, and of the prior, for a summary."""
        found = {"landing": self._wishes.as_lists(), "range_noise_ratio": self._noise_ratio}
        offset = self.prior_offset
        return found if offset is None else {**found, "prior": offset.values}

    @property
    def prior_offset(self) -> PriorOffset | None:
        return self._mapper.prior_offset

    def kill(self, node: str) -> None:
        """``mapping`` or ``lss`` is no more; of the mapper its last map stays latched."""
        self._down.add(node)

    def respawn(self, node: str, *, checkpoint: bool = True) -> None:
        """It is back, without what it had in memory."""
        self._down.discard(node)
        if node == "lss":
            self._start_lss()
            if self._mapper.stamp_ns:
                self._passes.changed()
            return
        self._start_mapping()
        if checkpoint and self._checkpoint is not None:
            self._mapper.import_state(self._checkpoint)
        if self._mapper.stamp_ns:
            self._passes.changed()

    def _start_mapping(self) -> None:
        self._intake, self._mapper = Intake(self._config), Mapper(self._config, self._prior)

    def _start_lss(self) -> None:
        self._assessments, self._chosen = _Assessments(self._delay_ns), False
        sinks = [self._assessments, *([self.history] if self.history is not None else [])]
        self._passes = Passes(self._config, self._wishes.arguments, sinks)
        self._passes.changes = self.targets
