# SPDX-License-Identifier: Apache-2.0
"""Node that publishes ranked landing sites and the target; `core.landing` computes them."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from quadtree_lss.onboard.config.risk import model_warning
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.outputs import CELLS, GRID_MAP, GROUND, OBSERVED, TOPIC_TYPES
from quadtree_lss.onboard.nodes.diagnostics import ERROR, OK, WARN, Durations, Status, failure
from quadtree_lss.onboard.nodes.entry import set_waiting_for
from quadtree_lss.onboard.nodes.landing_topics import LandingTopics
from quadtree_lss.onboard.nodes.losses import Publishers
from quadtree_lss.onboard.nodes.markers import MarkerPublisher, site_markers
from quadtree_lss.onboard.nodes.node_runner import BaseNode, run
from quadtree_lss.onboard.nodes.publishing import ChangePublisher
from quadtree_lss.onboard.nodes.qos import (
    OnDemandGroup,
    advertise,
    latched,
    steady_timer,
    stream,
    subscribe,
    take_waiting,
)
from quadtree_lss.onboard.nodes.received_map import ReceivedMap
from quadtree_lss.onboard.nodes.ros_messages import (
    POSE_KINDS,
    TYPES,
    GridMap,
    deserialised,
    message_maker,
)
from quadtree_lss.onboard.nodes.target_output import TargetOutput

if TYPE_CHECKING:
    from quadtree_lss.onboard.core.landing.result import LandingAssessment

CHECK_PERIOD_S = 0.2
"""Period of the checks that no message triggers: age of the map, settling."""


class LssNode(BaseNode):
    """Subscribe to the map and the landing inputs, publish ``landing/``; see ``msg_docs``."""

    def __init__(self) -> None:
        super().__init__("lss_node")
        config = self._config
        self._first_map_s = math.nan
        self._result: LandingAssessment | None = None
        self._assessed: CellMap | None = None
        self._failed = self._withheld = ""
        self._inputs_changed = self._logged_first = False
        self._lss_ms, self._delays = Durations(), Durations()
        self._had_subscribers: set[str] = set()
        self._output = ChangePublisher(self, config.publish.lss_rate, self._assess)
        self._inputs = LandingTopics(
            self, self._problems, self._on_input, config.lss.required_input
        )
        self._navigation = self._inputs.requests.navigation
        self._map_topic = self.resolve_topic_name(CELLS)
        effect = "maps of all are assessed"
        self._map_publishers = Publishers(self._map_topic, "map_publishers", effect, self._problems)
        binding = "frames.map" in self._settings.given
        self._map = ReceivedMap(
            self._problems, config.frames.map, lambda: self._config.lss, binding=binding
        )
        self._landing = {
            topic: advertise(self, TYPES[TOPIC_TYPES[topic]], topic, latched(), self._on_subscriber)
            for topic in GROUND
        }
        self._target = TargetOutput(self, self._age, self._release, self._land_now)
        publisher = advertise(self, MarkerArray, "landing/markers", latched())
        self._viewers = [MarkerPublisher(self, publisher, self._site_markers)]
        if GridMap is not None:
            publisher = advertise(self, GridMap, GRID_MAP, latched())
            self._viewers.append(MarkerPublisher(self, publisher, self._grid_map_message))
        self._subscribe()
        # Imported late: the middleware discovers mapping_node while the core loads.
        set_waiting_for("the landing modules")
        from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector

        self._selector = LandingSiteSelector(config)
        if warning := model_warning(config):
            self.get_logger().warning(warning)
        steady_timer(self, CHECK_PERIOD_S, self._check)
        self._announce()

    def _subscribe(self) -> None:
        """Subscribe to map and poses. Messages of topics in an `OnDemandGroup` do not wake the node
        while they are not needed; they are read together with the map."""
        matched = self._map_publishers.changed
        subscribe(self, PointCloud2, CELLS, self._on_cells, latched(), matched, raw=True)
        wanted = OnDemandGroup(lambda: self._map.lacks_observed)
        self._observed = subscribe(
            self, OccupancyGrid, OBSERVED, self._on_observed, latched(), group=wanted, raw=True
        )
        source = self._config.pose.source
        self._pose_kind = POSE_KINDS[source]
        profile = stream(1, reliable=False)  # matches any publisher
        wanted = OnDemandGroup(lambda: not self._navigation.known)
        self._poses = subscribe(
            self, self._pose_kind, f"nav/{source}", self._on_pose, profile, group=wanted, raw=True
        )

    def _reconfigure(self, config: Config) -> None:
        self._selector.configure(config)
        self._map.retry()
        self._on_input()

    def _on_input(self) -> None:
        """Assess the map again after a change of inputs or parameters."""
        self._inputs_changed = True
        self._output.changed()

    def _release(self) -> None:
        self._selector.release()
        self._inputs_changed = True
        self._output.now()

    def _land_now(self) -> None:
        self._selector.land_now()
        self._inputs_changed = True
        self._output.now()

    def _on_cells(self, raw: bytes) -> None:
        for observed in take_waiting(self._observed):
            self._on_observed(observed)
        if self._map.add_half("cells", raw):
            self._output.changed()

    def _on_observed(self, raw: bytes) -> None:
        if self._map.add_half("observed", raw):
            self._output.changed()

    def _on_pose(self, raw: bytes) -> None:
        try:
            self._navigation.use_pose(deserialised(raw, self._pose_kind))
        except MessageError as error:
            self._problems.report(f"pose_{error.reason}", f"pose not used: {error}")

    def _read_pose(self) -> None:
        for raw in take_waiting(self._poses):
            self._on_pose(raw)

    def _why_withheld(self) -> str:
        """Return why no site may be published; empty if one may."""
        reasons = (self._inputs.requests.why_withheld, self._map.withdrawal_reason())
        return "; ".join(reason for reason in reasons if reason)

    def _check(self) -> None:
        """Withdraw sites of an old map, end settling, and report missing inputs."""
        self._read_pose()
        set_waiting_for(self._missing_inputs() or self._why_no_site_yet())
        if self._result is None:
            return
        if self._why_withheld() != self._withheld:
            self._output.now()
        settling = self._result.selected.reason.key == "settling"
        if settling and self._waited() >= self._config.lss.settle_time:
            self._on_input()

    def _waited(self) -> float:
        """Return the time since the first map, s."""
        return time.monotonic() - self._first_map_s

    def _missing_inputs(self) -> str:
        """Return the inputs that the first assessment waits for; empty after it."""
        if self._result is not None:
            return ""
        if missing := self._map.missing():
            number = self._map_publishers.number
            return f"{missing} (publishers known on '{self._map_topic}': {number})"
        return " and ".join(f"landing/{name}" for name in self._inputs.unheard())

    def _why_no_site_yet(self) -> str:
        """Return why no assessment had a site yet; empty after the first site."""
        if self._logged_first or self._result is None:
            return ""
        why = self._why_withheld() or self._failed or self._result.explanation
        return f"the first site: {why}"

    def _assess(self) -> None:
        self._map.decode_newest()
        cells = self._map.cells
        if cells is None:
            return
        self._inputs.use_frame(self._map.frame)
        if math.isnan(self._first_map_s):
            self._first_map_s = time.monotonic()
        withheld = self._why_withheld()
        if cells is self._assessed and withheld == self._withheld and not self._inputs_changed:
            return  # the new map was rejected
        if not self._inputs.settled():
            return
        new = cells is not self._assessed
        self._assessed, self._withheld, self._inputs_changed = cells, withheld, False
        self._read_pose()
        start = time.perf_counter()
        requests = {**self._inputs.requests.arguments(), "why_withheld": withheld}
        try:
            self._failed = ""
            with self._target.repeated():
                result = self._selector.assess(cells, waited=self._waited(), **requests)
            self._send(result, new)
        except Exception as error:
            self._failed = failure("the assessment", error, self.get_logger())
            self._problems.report("pass_failed", self._failed)
            self._send(self._selector.withhold(cells, self._failed), new)
        self._lss_ms.add(1e3 * (time.perf_counter() - start))

    def _send(self, result: LandingAssessment, new: bool) -> None:
        """Publish an assessment; ``new``: the map is new."""
        self._target.send(result, self._map.frame)
        self._result = result
        self._send_ground(self._had_subscribers)
        if result.pending:
            self._on_input()
        sites = result.sites
        if not self._logged_first and len(sites.score):
            self._logged_first = True
            x, y, z = sites.position[0]
            text = f"first sites: {len(sites.score)}, the best at x {x:.2f}, y {y:.2f}, z {z:.2f} m"
            self.get_logger().info(f"{text}; {result.explanation}")
        for viewer in self._viewers:
            viewer.changed = True
        if new:
            self._delays.add(1e3 * self._age(result.stamp_ns))

    def _on_subscriber(self, _: Any) -> None:
        """Publish topics with a first subscriber; topics without one are not computed."""
        publishers = self._landing.items()
        subscribed = {topic for topic, pub in publishers if pub.get_subscription_count()}
        new = subscribed - self._had_subscribers
        self._had_subscribers |= new
        self._send_ground(new)

    def _send_ground(self, topics: set[str]) -> None:
        if self._result is not None:
            for topic, message in message_maker(self._map.frame).of_ground(self._result, topics):
                self._landing[topic].publish(message)

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
            self._map.decode_newest()  # a map that was not decoded yet counts if it is usable
        status.check_age("map", self._map_topic, self._map.arrivals, limits)
        latency = self._delays.pop_span()
        text = "delay of sites, by the map's stamp and this node's clock:"
        status.check_delay(text, latency, limits)
        self._map_publishers.add_warning(status)
        status.add(
            {
                "map.refused": self._map.refusals,
                "map.publishers": self._map_publishers.number,
                "assessments": 0 if self._result is None else self._result.number,
                "lss_ms": self._lss_ms.pop_span(),
                "latency_ms": latency,
            }
        )
        status.add({f"landing.{name}": state for name, state in self._inputs.states().items()})
        withheld = self._why_withheld()
        for why in filter(None, (self._failed, withheld)):
            status.note(ERROR, f"no site is given out: {why}")
        if self._map.refused and not withheld:
            status.note(ERROR, f"{self._map.refused}; the previous map stays in use")
        result = self._result
        if missing := self._missing_inputs():
            status.note(WARN, f"no site is given out yet: waiting for {missing}")
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
            status.note(WARN, "no safe site: " + result.explanation.removeprefix("no safe site: "))


def main(args: Sequence[str] | None = None) -> int:
    """Console script ``lss_node``."""
    return run(LssNode, "lss_node: the map to hazards and ranked landing sites", args)
