# SPDX-License-Identifier: Apache-2.0
"""A flight in lock-step: the functions of the nodes, called in simulated time without transport."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from quadtree_lss.desk.bags.message_types import typestore
from quadtree_lss.desk.replay.assessments import Assessments, History, TargetChange
from quadtree_lss.lab.flight.flight import Flight, FlightMessage, flight_config
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

#: Period at which ``landing/selected`` is repeated, as in lss_node, ns.
REPEAT_PERIOD_NS = 400_000_000
#: Delay from an assessment to its arrival at guidance, ns.
ASSESSMENT_DELAY_NS = 60_000_000
#: Node that a fault kills.
KILLED_NODES = {"kill_lss": "lss", "kill_mapping": "mapping", "forget_mapping": "mapping"}


@dataclass(frozen=True)
class FlightResult:
    """Result of a flight; what follows ``last`` is empty unless it was recorded."""

    flight: Flight
    figures: dict[str, Any]  # content of ``touchdown.json``
    last: LandingAssessment | None  # None without nodes
    cells: CellMap | None = None
    history: History | None = None
    targets: tuple[TargetChange, ...] = ()
    summary: dict[str, Any] = field(default_factory=dict)  # values for ``summary.json``


def fly_lockstep(
    seed: int,
    settings: FlightSettings,
    *,
    ground: Ground | None = None,
    progress: Callable[[float], None] | None = None,
    record: bool = False,
) -> FlightResult:
    """Fly in lock-step, over ``ground`` if it exists already. ``progress`` is called with the
    simulated time, s; ``record`` keeps map, history and targets for the page."""
    flight = Flight(seed, settings, ground)
    if not flight.scanning:
        run_flight(flight, None, progress)
        return FlightResult(flight, flight_figures(seed, flight, None), None)
    config, history = flight_config(settings, flight.ground), History() if record else None
    nodes = LockstepNodes(config, history)
    run_flight(flight, nodes, progress)
    found = FlightResult(flight, flight_figures(seed, flight, nodes.last), nodes.last)
    return nodes.recorded(found) if record else found


def run_flight(flight: Flight, nodes: Any, progress: Callable[[float], None] | None) -> None:
    """Run a flight to its end, with `LockstepNodes`, `lab.live.flight.LiveNodes` or no nodes."""
    before: set[str] = set()
    while not flight.outcome:
        sent = flight.step()
        if nodes is not None:
            now = set(flight.active)
            if "land_now" in now - before:
                nodes.land_now()
            for kind, node in KILLED_NODES.items():
                if kind in now - before:
                    nodes.kill(node)
                elif kind in before - now:
                    nodes.respawn(node, checkpoint=kind != "forget_mapping")
            before = now
            for message in sent:
                nodes.publish(message, flight.stamp_ns)
            for target in nodes.step(flight.stamp_ns):
                flight.pilot.on_selected(target)
        if progress is not None and int(100 * flight.time) % 100 == 0:
            progress(flight.time)


def flight_figures(seed: int, flight: Flight, last: LandingAssessment | None) -> dict[str, Any]:
    """Content of ``touchdown.json``."""
    figures = {"seed": seed, "avoidance": flight.settings.avoidance, **flight.result()}
    warnings = "; ".join(() if last is None else last.warnings)
    said = "nothing" if last is None else ground_class(last, figures["x"], figures["y"])
    return figures | {"map_said": said, "warnings": warnings}


def ground_class(last: LandingAssessment, x: float, y: float) -> str:
    """Class of the ground at (x, y) in an assessment, as listed in ``docs/topics_and_files.md``."""
    at = int(abs(last.y - y).argmin()), int(abs(last.x - x).argmin())
    hazard = int(last.hazard[at])
    if hazard & UNSEEN:
        return "unmapped" if hazard & UNMAPPED else "unseen"
    return "unsafe" if hazard & TOUCHDOWN else "safe" if last.safe[at] else "partly_unobserved"


class LockstepNodes:
    """mapping_node and lss_node without transport. A killed node loses its state, but latched
    messages remain. ``last`` is the last assessment that guidance received."""

    def __init__(self, config: Config, history: History | None = None) -> None:
        self._config = config
        self._messages = Messages(typestore(ros1=False).types, frame=config.frames.map)
        self._requests = LandingRequests(config.frames.map)
        self._checkpoint: Any = None
        self._checkpoint_ns = 0
        self._killed: set[str] = set()
        self.last: LandingAssessment | None = None
        self.history, self._noise_ratio = history, float("nan")
        self.targets: list[TargetChange] = []
        self._start_mapping()
        self._start_lss()

    def publish(self, sent: FlightMessage, now_ns: int) -> None:
        topic, message = sent.topic, sent.message(self._messages)
        if topic == "nav/pose":
            self._requests.navigation.use_pose(message)
        if topic.startswith("landing/"):
            self._requests.use_message(topic.removeprefix("landing/"), message)
            self._passes.landing_changed()
        elif "mapping" in self._killed:
            return
        elif topic == "nav/pose":
            self._intake.on_pose(message)
        else:
            self._intake.on_cloud(message, now_ns)

    def step(self, now_ns: int) -> list[Array | None]:
        """Map the scans that are ready and assess the map if due; return the new messages on
        ``landing/selected``: positions (3,), or None without a target."""
        if "mapping" not in self._killed:
            self.mapper.set_area(self._requests.values[AREA])
            for scan in self._intake.ready(now_ns):
                report = self.mapper.update(scan.points_lidar, scan.pose, scan.sweep)
                self._noise_ratio = report.noise_ratio
                if self.history is not None:
                    self.history.scan(scan)
                self._passes.changed()
            self._intake.notices()
            if now_ns - self._checkpoint_ns >= 1e9 * CHECKPOINT_S:
                self._checkpoint, self._checkpoint_ns = self.mapper.export_state(), now_ns
        if "lss" in self._killed:
            return []
        self._passes.tick(now_ns, self.mapper.snapshot)
        if self._queue and self._queue[0][0] <= now_ns:
            self._published = self.last = self._queue.pop(0)[1]
        elif self._published is None or now_ns - self._published_ns < REPEAT_PERIOD_NS:
            return []
        self._published_ns, said = now_ns, self._published
        self._chosen = self._chosen or not said.undecided
        if not self._chosen:  # lss_node publishes nothing before its first decision
            return []
        return [said.selected.position.copy() if said.selected.id else None]

    def _queue_assessment(self, now_ns: int, found: LandingAssessment) -> None:
        self._queue.append((now_ns + ASSESSMENT_DELAY_NS, found))

    def land_now(self) -> None:
        self._passes.land_now()

    def recorded(self, found: FlightResult) -> FlightResult:
        """Add the final map, its assessment and the values of the summary."""
        self._passes.finish(found.flight.stamp_ns, self.mapper.snapshot)
        summary = {"landing": self._requests.as_lists(), "range_noise_ratio": self._noise_ratio}
        last, cells, targets = self._passes.last, self._passes.cells, tuple(self.targets)
        record = {"history": self.history, "targets": targets, "summary": summary}
        return replace(found, last=last, cells=cells, **record)

    def kill(self, node: str) -> None:
        """Kill ``mapping`` or ``lss``."""
        self._killed.add(node)

    def respawn(self, node: str, *, checkpoint: bool = True) -> None:
        """Restart a killed node, mapping with its last checkpoint."""
        self._killed.discard(node)
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
        self._queue: list[tuple[int, LandingAssessment]] = []
        self._published: LandingAssessment | None = None
        self._published_ns, self._chosen = 0, False
        self._passes = Assessments(self._config, self._requests.arguments)
        self._passes.on_assessment.append(self._queue_assessment)
        if self.history is not None:
            self._passes.on_assessment.append(self.history.landing)
        self._passes.changes = self.targets
