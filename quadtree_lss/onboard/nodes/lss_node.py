# SPDX-License-Identifier: Apache-2.0
"""The map in, ranked landing sites out. Computes nothing: the core does."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from quadtree_lss.onboard.config.risk import model_warning
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.outputs import CELLS, GRID_MAP, GROUND, OBSERVED, TOPIC_TYPES
from quadtree_lss.onboard.nodes.diagnostics import ERROR, OK, WARN, Durations, Status, failure
from quadtree_lss.onboard.nodes.entry import waits_for
from quadtree_lss.onboard.nodes.executor import WhenWanted, arrived, steady_timer
from quadtree_lss.onboard.nodes.landing_topics import LandingTopics
from quadtree_lss.onboard.nodes.losses import Publishers
from quadtree_lss.onboard.nodes.markers import MarkerPublisher, site_markers
from quadtree_lss.onboard.nodes.node_runner import BaseNode, run
from quadtree_lss.onboard.nodes.publishing import ChangePublisher
from quadtree_lss.onboard.nodes.qos import advertise, latched, stream, subscribe
from quadtree_lss.onboard.nodes.received_map import ReceivedMap
from quadtree_lss.onboard.nodes.ros_messages import TYPES, GridMap, message_maker, pose_message
from quadtree_lss.onboard.nodes.target_output import TargetOutput

if TYPE_CHECKING:
    from quadtree_lss.onboard.core.landing.result import LandingAssessment

LOOK_PERIOD_S = 0.2
"""How often the age of the map is looked at."""


class LssNode(BaseNode):
    """Takes the map and where landing is wanted, publishes ``landing/``; see ``msg_docs``."""

    def __init__(self) -> None:
        super().__init__("lss_node")
        config = self._config
        self._output = ChangePublisher(self, config.publish.lss_rate, self._assess)
        # Before the map: of what is there when the node starts, they are to be looked at first.
        self._inputs = LandingTopics(self, self._problems, self._ask, config.lss.required_input)
        self._map_topic = self.resolve_topic_name(CELLS)
        effect = "maps of either are assessed"
        self._map_publishers = Publishers(self._map_topic, "map_publishers", effect, self._problems)
        binding = "frames.map" in self._settings.given
        self._map = ReceivedMap(
            self._problems, config.frames.map, lambda: self._config.lss, binding=binding
        )
        kinds, told = (PointCloud2, OccupancyGrid), self._map_publishers.changed
        subscribe(self, kinds[0], CELLS, self._on_cells, latched(), told, raw=True)
        # It is sent first: the cells take it along.
        other = WhenWanted(lambda: self._map.lacks_observed)
        self._observed = subscribe(
            self, kinds[1], OBSERVED, self._on_observed, latched(), group=other, raw=True
        )
        poses = config.pose.source
        self._pose_kind: Any = {"pose": PoseWithCovarianceStamped, "odometry": Odometry}[poses]
        self._navigation = self._inputs.wishes.navigation
        # Best effort: it matches any publisher. The newest is enough, and taken when it is needed.
        first = WhenWanted(lambda: not self._navigation.known)
        kind, profile = self._pose_kind, stream(1, reliable=False)
        self._poses = subscribe(
            self, kind, f"nav/{poses}", self._on_pose, profile, group=first, raw=True
        )
        self._began = float("nan")
        self._result: LandingAssessment | None = None
        self._failed = ""
        self._assessed: CellMap | None = None
        self._withheld = ""
        self._asked = False
        self._first_told = False
        self._lss_ms, self._delays = Durations(), Durations()
        self._heard: set[str] = set()
        self._landing = {
            topic: advertise(self, TYPES[TOPIC_TYPES[topic]], topic, latched(), self._on_listener)
            for topic in GROUND
        }
        self._target = TargetOutput(
            self,
            self._age,
            lambda: self._at_once(self._selector.release),
            lambda: self._at_once(self._selector.land_now),
        )
        self._markers = MarkerPublisher(
            self, advertise(self, MarkerArray, "landing/markers", latched()), self._site_markers
        )
        self._grid_map = None
        if GridMap is not None:
            publisher = advertise(self, GridMap, GRID_MAP, latched())
            self._grid_map = MarkerPublisher(self, publisher, self._grid_map_message)
        steady_timer(self, LOOK_PERIOD_S, self._look_around)
        # This takes a while to load, in which the middleware already finds mapping_node.
        waits_for("what judges landing")
        from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector

        self._selector = LandingSiteSelector(config)
        if said := model_warning(config):
            self.get_logger().warning(said)
        self._announce()

    def _reconfigure(self, config: Config) -> None:
        self._selector.configure(config)
        self._map.retry()
        self._ask()

    def _ask(self) -> None:
        """Something else than the map changed."""
        self._asked = True
        self._output.changed()

    def _at_once(self, ask: Callable[[], None]) -> None:
        """Somebody asked the selector for another target, or for the best within reach."""
        ask()
        self._asked = True
        self._output.now()

    def _age(self, stamp_ns: int) -> float:
        """Of what has a stamp, by the node's clock, s; NaN if the two are not of one time."""
        latency = self._latency_ms(stamp_ns)
        return float("nan") if latency is None else 1e-3 * latency

    def _on_cells(self, raw: bytes) -> None:
        for observed in arrived(self._observed):
            self._on_observed(observed)
        if self._map.complete_with("cells", raw):
            self._output.changed()

    def _on_observed(self, raw: bytes) -> None:
        if self._map.complete_with("observed", raw):
            self._output.changed()

    def _on_pose(self, raw: bytes) -> None:
        try:
            self._navigation.take(pose_message(raw, self._pose_kind))
        except MessageError as error:
            self._problems.report(f"pose_{error.reason}", f"pose not used: {error}")

    def _take_pose(self) -> None:
        for raw in arrived(self._poses):
            self._on_pose(raw)

    def _withhold(self) -> str:
        """Why no site may be given out, empty if nothing speaks against it."""
        reasons = (self._inputs.wishes.withheld, self._map.too_old())
        return "; ".join(reason for reason in reasons if reason)

    def _look_around(self) -> None:
        """Withdraws the sites when the map has become too old; says what it waits for; ends the
        wait for a target."""
        self._take_pose()
        waits_for(self._lacks() or self._why_none())
        if self._result is None:
            return
        if self._withhold() != self._withheld:
            self._output.now()
        settling = self._result.selected.reason.key == "settling"
        if settling and self._waited() >= self._config.lss.settle_time:
            self._ask()

    def _waited(self) -> float:
        """Since the first map, s."""
        return time.monotonic() - self._began

    def _lacks(self) -> str:
        """What there is not yet of all that the first answer takes, empty after it."""
        if self._result is not None:
            return ""
        if lack := self._map.lacks():
            number = self._map_publishers.number
            return f"{lack} (publishers known on '{self._map_topic}': {number})"
        return " and ".join(f"landing/{name}" for name in self._inputs.unheard())

    def _why_none(self) -> str:
        """Why no site was given out yet, though there are answers."""
        if self._first_told or self._result is None:
            return ""
        return f"the first site: {self._withhold() or self._failed or self._result.explanation}"

    def _assess(self) -> None:
        self._map.take()
        cells = self._map.cells
        if cells is None:
            return
        self._inputs.use_frame(self._map.frame)
        self._began = time.monotonic() if math.isnan(self._began) else self._began
        withheld = self._withhold()
        if cells is self._assessed and withheld == self._withheld and not self._asked:
            return  # what came was refused
        if not self._inputs.settled():
            return
        new = cells is not self._assessed
        self._assessed, self._withheld, self._asked = cells, withheld, False
        self._take_pose()
        start = time.perf_counter()
        restrictions = {**self._inputs.wishes.arguments(), "withheld": withheld}
        try:
            self._failed = ""
            with self._target.held_up():
                result = self._selector.assess(cells, waited=self._waited(), **restrictions)
            self._give(result, new)
        except Exception as error:
            self._failed = failure("the landing site pass", error, self.get_logger())
            self._problems.report("pass_failed", self._failed)
            self._give(self._selector.withhold(cells, self._failed), new)
        self._lss_ms.add(1e3 * (time.perf_counter() - start))

    def _give(self, result: LandingAssessment, new: bool) -> None:
        """Send an answer; ``new`` if it is of another map than the one before."""
        self._target.send(result, self._map.frame)
        self._result = result
        self._send_ground(self._heard)
        if result.pending:
            self._ask()
        self._tell_first(result)
        self._markers.changed()
        if self._grid_map is not None:
            self._grid_map.changed()
        latency = self._latency_ms(result.stamp_ns)
        if new and latency is not None:
            self._delays.add(latency)

    def _on_listener(self, _: Any) -> None:
        """What nobody has ever subscribed to is not made; whoever comes first gets it then."""
        new = {one for one in GROUND if self._landing[one].get_subscription_count()} - self._heard
        self._heard |= new
        self._send_ground(new)

    def _send_ground(self, topics: set[str]) -> None:
        if self._result is not None:
            for topic, message in message_maker(self._map.frame).of_ground(self._result, topics):
                self._landing[topic].publish(message)

    def _tell_first(self, result: LandingAssessment) -> None:
        """One line when there are sites for the first time."""
        sites = result.sites
        if not self._first_told and len(sites.score):
            self._first_told = True
            x, y, z = sites.position[0]
            self.get_logger().info(
                f"first sites: {len(sites.score)}, the best at x {x:.2f}, y {y:.2f}, z {z:.2f} m;"
                f" {result.explanation}"
            )

    def _site_markers(self) -> MarkerArray | None:
        if self._result is None:
            return None
        return site_markers(self._result, self._map.frame, self._config.lss.zone)

    def _grid_map_message(self) -> Any:
        result = self._result
        return None if result is None else message_maker(self._map.frame).grid_map(result)

    def _collect(self, status: Status) -> None:
        limits = self._config.diagnostics
        if self._map.arrivals.age() > limits.warn_age:
            self._map.take()  # one that waits for its turn counts if it can be used
        status.judge_age("map", self._map_topic, self._map.arrivals, limits)
        latency = self._delays.take()
        text = "by the map's stamp and this node's clock, sites are sent after"
        status.judge_delay(text, latency, limits)
        self._map_publishers.judge(status)
        status.add(
            {
                "map.refused": self._map.refusals,
                "map.publishers": self._map_publishers.number,
                "assessments": 0 if self._result is None else self._result.number,
                "lss_ms": self._lss_ms.take(),
                "latency_ms": latency,
            }
        )
        status.add({f"landing.{name}": state for name, state in self._inputs.states().items()})
        withheld = self._withhold()
        if self._failed:
            status.note(ERROR, f"no site is given out: {self._failed}")
        if withheld:
            status.note(ERROR, f"no site is given out: {withheld}")
        elif self._map.refused:
            status.note(ERROR, f"{self._map.refused}; the one before it holds")
        result = self._result
        if lack := self._lacks():
            status.note(WARN, f"no site is given out yet: waiting for {lack}")
        if result is None or self._map.cells is None:
            return
        count = len(result.sites.score)
        status.add(
            {
                "map.stamp_ns": result.stamp_ns,
                "map.leaves": len(self._map.cells.level),
                "sites": count,
                "target.id": result.selected.id,
                "target.reason": result.selected.reason.key,
                "target.state": result.selected.state.name.lower(),
                "target.probability": result.selected.probability,
                "target.why": result.why,
                "seen": result.seen,
                "explanation": result.explanation,
            }
        )
        if withheld or self._failed:
            return
        for line in result.warnings:
            status.note(WARN, line)
        if count:
            status.note(OK, f"{count} sites; {result.explanation}")
            if not (result.selected.id or result.pending or result.undecided):
                status.note(WARN, result.why)
        else:
            reason = result.explanation.removeprefix("no safe site: ")
            status.note(WARN, f"no safe site: {reason}")


def main(args: Sequence[str] | None = None) -> int:
    """Console script ``lss_node``."""
    return run(LssNode, "lss_node: the map to hazards and ranked landing sites", args)
