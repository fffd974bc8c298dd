# SPDX-License-Identifier: Apache-2.0
"""A flight in lock-step, from a seed and settings to figures.

Without transport, in the flight's time: `Intake`, `Mapper` and `Assessments`, as in a replay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from quadtree_lss.desk.bags.message_types import typestore
from quadtree_lss.desk.replay.assessments import Assessments, TargetChange
from quadtree_lss.desk.replay.history import History
from quadtree_lss.lab.flight.flight import Flight, Sent, flight_config
from quadtree_lss.lab.flight.ground import Ground
from quadtree_lss.lab.flight.settings import FlightSettings
from quadtree_lss.lab.simulation.recording import Messages
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.sections import CHECKPOINT_S
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.hazards import TOUCHDOWN, UNMAPPED, UNSEEN
from quadtree_lss.onboard.core.landing.result import LandingAssessment
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.intake import Intake
from quadtree_lss.onboard.messages.landing_inputs import AREA, LandingRequests

#: Period at which ``landing/selected`` is repeated, as by lss_node.
REPEAT_NS = 400_000_000
#: Delay from an assessment to guidance, ns.
DELAY_NS = 60_000_000
#: Faults that kill a node.
KILLS = {"kill_lss": "lss", "kill_mapping": "mapping", "forget_mapping": "mapping"}


@dataclass(frozen=True)
class Flown:
    """A flight that has ended: its final state and record, figures (``docs/topics_and_files.md``),
    and the last assessment, None without nodes. If recorded: ``cells``, the map at the end, its
    ``history``, changes of the target, and values for the ``summary``."""

    flight: Flight
    figures: dict[str, Any]
    last: LandingAssessment | None
    cells: CellMap | None = None
    history: History | None = None
    targets: tuple[TargetChange, ...] = ()
    summary: dict[str, Any] = field(default_factory=dict)


def flown(
    seed: int,
    settings: FlightSettings,
    *,
    ground: Ground | None = None,
    progress: Callable[[float], None] | None = None,
    record: bool = False,
) -> Flown:
    """Fly a seed; ``record`` keeps what the page shows. ``ground``: of this seed, if made before.
    ``progress`` gets the seconds flown."""
    flight = Flight(seed, settings, ground)
    if not flight.scanning:
        fly(flight, None, progress)
        return Flown(flight, figures_of(seed, flight, None), None)
    config, history = flight_config(settings, flight.ground), History() if record else None
    nodes = LockstepNodes(config, history)
    fly(flight, nodes, progress)
    found = Flown(flight, figures_of(seed, flight, nodes.last), nodes.last)
    return nodes.recorded(found) if record else found


def fly(flight: Flight, nodes: Any, progress: Callable[[float], None] | None) -> None:
    """Fly to the end, with `LockstepNodes`, `lab.live.flight.LiveNodes` or None."""
    before: set[str] = set()
    while not flight.outcome:
        sent = flight.step()
        if nodes is not None:
            now = set(flight.active)
            if "land_now" in now - before:
                nodes.land_now()
            for kind, node in KILLS.items():
                if kind in now - before:
                    nodes.kill(node)
                elif kind in before - now:
                    nodes.respawn(node, checkpoint=kind != "forget_mapping")
            before = now
            for message in sent:
                nodes.take(message, flight.stamp_ns)
            for said in nodes.work(flight.stamp_ns):
                flight.pilot.hear(said)
        if progress is not None and int(100 * flight.time) % 100 == 0:
            progress(flight.time)


def figures_of(seed: int, flight: Flight, last: LandingAssessment | None) -> dict[str, Any]:
    """Figures of a flight for JSON."""
    figures = {"seed": seed, "avoidance": flight.settings.avoidance, **flight.result()}
    warnings = "; ".join(() if last is None else last.warnings)
    said = "nothing" if last is None else map_said(last, figures["x"], figures["y"])
    return figures | {"map_said": said, "warnings": warnings}


def map_said(last: LandingAssessment, x: float, y: float) -> str:
    """Class of a place in an assessment, as listed in docs/topics_and_files.md."""
    at = int(abs(last.y - y).argmin()), int(abs(last.x - x).argmin())
    hazard = int(last.hazard[at])
    if hazard & UNSEEN:
        return "unmapped" if hazard & UNMAPPED else "unseen"
    return "unsafe" if hazard & TOUCHDOWN else "safe" if last.safe[at] else "partly_unobserved"


class LockstepNodes:
    """mapping_node and lss_node without transport. A killed node loses its memory, not latched
    messages. ``last``: the last assessment that guidance got."""

    def __init__(self, config: Config, history: History | None = None) -> None:
        self._config = config
        self._make = Messages(typestore(ros1=False).types, frame=config.frames.map)
        self._requests = LandingRequests(config.frames.map)
        self._checkpoint: Any = None
        self._checkpoint_ns = 0
        self._down: set[str] = set()
        self.last: LandingAssessment | None = None
        self.history, self._noise_ratio = history, float("nan")
        self.targets: list[TargetChange] = []
        self._start_mapping()
        self._start_lss()

    def take(self, sent: Sent, now_ns: int) -> None:
        topic, message = sent.topic, sent.message(self._make)
        if topic == "nav/pose":
            self._requests.navigation.use_pose(message)
        if topic.startswith("landing/"):
            self._requests.use_message(topic.removeprefix("landing/"), message)
            self._passes.landing_changed()
        elif "mapping" in self._down:
            return
        elif topic == "nav/pose":
            self._intake.on_pose(message)
        else:
            self._intake.on_cloud(message, now_ns)

    def work(self, now_ns: int) -> list[Array | None]:
        """Map and assess what is due; return new messages on ``landing/selected``: places (3,), or
        None for no target."""
        if "mapping" not in self._down:
            self.mapper.look_at(self._requests.values[AREA])
            for scan in self._intake.ready(now_ns):
                report = self.mapper.update(scan.points_lidar, scan.pose, scan.sweep)
                self._noise_ratio = report.noise_ratio
                if self.history is not None:
                    self.history.scan(scan)
                self._passes.changed()
            self._intake.notices()
            if now_ns - self._checkpoint_ns >= 1e9 * CHECKPOINT_S:
                self._checkpoint, self._checkpoint_ns = self.mapper.export_state(), now_ns
        if "lss" in self._down:
            return []
        self._passes.tick(now_ns, self.mapper.snapshot)
        if self._waiting and self._waiting[0][0] <= now_ns:
            self._said = self.last = self._waiting.pop(0)[1]
        elif self._said is None or now_ns - self._said_ns < REPEAT_NS:
            return []
        self._said_ns, said = now_ns, self._said
        self._chosen = self._chosen or not said.undecided
        if not self._chosen:  # as lss_node, of which the one before may have named a target
            return []
        return [said.selected.position.copy() if said.selected.id else None]

    def _answer(self, now_ns: int, found: LandingAssessment) -> None:
        self._waiting.append((now_ns + DELAY_NS, found))

    def land_now(self) -> None:
        self._passes.land_now()

    def recorded(self, found: Flown) -> Flown:
        """Add the final map, its assessment, and values for the summary."""
        self._passes.finish(found.flight.stamp_ns, self.mapper.snapshot)
        summary = {"landing": self._requests.as_lists(), "range_noise_ratio": self._noise_ratio}
        last, cells, targets = self._passes.last, self._passes.cells, tuple(self.targets)
        record = {"history": self.history, "targets": targets, "summary": summary}
        return replace(found, last=last, cells=cells, **record)

    def kill(self, node: str) -> None:
        """End ``mapping`` or ``lss``; the last map stays latched."""
        self._down.add(node)

    def respawn(self, node: str, *, checkpoint: bool = True) -> None:
        """Start a killed node again."""
        self._down.discard(node)
        if node == "lss":
            self._start_lss()
        else:
            self._start_mapping()
            if checkpoint and self._checkpoint is not None:
                self.mapper.import_state(self._checkpoint)
        if self.mapper.stamp_ns:
            self._passes.changed()

    def _start_mapping(self) -> None:
        self._intake, self.mapper = Intake(self._config), Mapper(self._config)

    def _start_lss(self) -> None:
        self._waiting: list[tuple[int, LandingAssessment]] = []
        self._said: LandingAssessment | None = None
        self._said_ns, self._chosen = 0, False
        self._passes = Assessments(self._config, self._requests.arguments)
        self._passes.on_assessment.append(self._answer)
        if self.history is not None:
            self._passes.on_assessment.append(self.history.landing)
        self._passes.changes = self.targets
