# SPDX-License-Identifier: Apache-2.0
"""The map in, ranked landing sites out. Computes nothing: the core does."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from geometry_msgs.msg import PoseArray
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2
from visualization_msgs.msg import MarkerArray

from quadtree_lss.config.settings import Config
from quadtree_lss.core.tree.cell_map import CellMap
from quadtree_lss.messages.clouds import MessageError
from quadtree_lss.messages.maps import MapMessageError
from quadtree_lss.messages.poses import check_frame
from quadtree_lss.ros.diagnostics import ERROR, OK, WARN, Diagnostics, Status
from quadtree_lss.ros.landing_inputs import LandingInputs
from quadtree_lss.ros.markers import MarkerPublisher, site_markers
from quadtree_lss.ros.messages import landing_messages, map_from_messages
from quadtree_lss.ros.monitor import Arrivals, Durations
from quadtree_lss.ros.node_runner import run
from quadtree_lss.ros.parameters import NodeParameters
from quadtree_lss.ros.problems import Problems
from quadtree_lss.ros.publishers import Publishers
from quadtree_lss.ros.qos import advertise, latched, subscribe
from quadtree_lss.ros.rate_limit import ChangePublisher

if TYPE_CHECKING:
    from quadtree_lss.core.landing.sites import LandingAssessment

CELLS, OBSERVED = "map/cells", "map/observed"


class LssNode(Node):
    """Takes the map and where landing is wanted, publishes ``landing/``; see ``msg_docs``."""

    def __init__(self) -> None:
        super().__init__("lss_node", automatically_declare_parameters_from_overrides=True)
        self._settings = NodeParameters(self, self._reconfigure)
        config = self._settings.config
        self._problems = Problems(self.get_logger())
        self._output = ChangePublisher(self, config.publish.lss_rate, self._assess)
        # Before the map: of what is there when the node starts, they are to be looked at first.
        self._inputs = LandingInputs(
            self, self._problems, self._output.changed, config.lss.required_input
        )
        self._map_topic = self.resolve_topic_name(CELLS)
        effect = "maps of either are assessed"
        self._map_publishers = Publishers(self._map_topic, "map_publishers", effect, self._problems)
        subscribe(self, PointCloud2, CELLS, self._on_cells, latched(), self._map_publishers.changed)
        subscribe(self, OccupancyGrid, OBSERVED, self._on_observed, latched())
        self._newest: dict[str, Any] = {}
        self._cells: CellMap | None = None
        self._result: LandingAssessment | None = None
        self._frame = config.frames.map
        self._assessments = 0
        self._maps = Arrivals()
        self._lss_ms, self._latency_ms = Durations(), Durations()
        self._diagnostics = Diagnostics(
            self, config.publish.diagnostics_rate, self._problems, self._collect
        )
        self._landing = {
            topic: advertise(self, kind, topic, latched())
            for topic, kind in (
                ("landing/sites", PoseArray),
                ("landing/site_table", PointCloud2),
                ("landing/hazards", OccupancyGrid),
                ("landing/score", OccupancyGrid),
            )
        }
        self._markers = MarkerPublisher(
            self,
            config.publish.marker_rate,
            advertise(self, MarkerArray, "landing/markers", latched()),
            self._site_markers,
        )
        # This takes a while to load, in which the middleware already finds mapping_node.
        from quadtree_lss.core.landing.sites import LandingSiteSelector

        self._selector = LandingSiteSelector(config)

    def _reconfigure(self, config: Config) -> None:
        self._selector.configure(config)
        self._output.changed()

    def _on_cells(self, message: Any) -> None:
        self._newest["cells"] = message
        self._join()

    def _on_observed(self, message: Any) -> None:
        self._newest["observed"] = message
        self._join()

    def _join(self) -> None:
        """A map is complete when both its messages carry the same stamp.

        Neither is used twice: the next map may have the same stamp, and its cells must not be
        joined with what was observed before. Only the newest map is kept and decoded when its
        turn comes: maps are skipped, not queued.
        """
        cells, observed = self._newest.get("cells"), self._newest.get("observed")
        if cells is None or observed is None or cells.header.stamp != observed.header.stamp:
            return
        self._newest = {"map": (cells, observed)}
        self._maps.add()
        self._output.changed()

    def _decode(self) -> None:
        cells, observed = self._newest.pop("map")
        frame = cells.header.frame_id
        try:
            if "frames.map" in self._settings.given:
                check_frame(frame, self._settings.config.frames.map, "map/cells")
            self._cells = map_from_messages(cells, observed)
        except (MapMessageError, MessageError) as error:
            self._problems.report(f"map.{error.reason}", f"map not used: {error}")
        else:
            self._frame = frame
            self._inputs.use_frame(frame)

    def _assess(self) -> None:
        if "map" in self._newest:
            self._decode()
        if self._cells is None or not self._inputs.settled():
            return
        start = time.perf_counter()
        result = self._selector.assess(self._cells, **self._inputs.restrictions())
        self._lss_ms.add(1e3 * (time.perf_counter() - start))
        for topic, message in landing_messages(result, self._frame).items():
            self._landing[topic].publish(message)
        self._assessments += 1
        self._result = result
        self._markers.changed()
        latency = self._diagnostics.latency_ms(result.stamp_ns)
        if latency is not None:
            self._latency_ms.add(latency)

    def _site_markers(self) -> MarkerArray | None:
        if self._result is None:
            return None
        lss = self._settings.config.lss
        return site_markers(self._result, self._frame, 0.5 * lss.vehicle_diameter + lss.margin)

    def _collect(self, status: Status) -> None:
        status.judge_age("map", self._map_topic, self._maps, self._settings.config.diagnostics)
        status.add(
            {
                "map.publishers": self._map_publishers.number,
                "assessments": self._assessments,
                "lss_ms": self._lss_ms.take(),
                "latency_ms": self._latency_ms.take(),
            }
        )
        status.add({f"landing.{name}": state for name, state in self._inputs.states().items()})
        if self._inputs.withheld:
            status.note(ERROR, f"no site is given out: {self._inputs.withheld}")
        result = self._result
        if result is None and self._cells is not None:
            names = " and ".join(f"landing/{name}" for name in self._inputs.unheard())
            status.note(WARN, f"no site is given out yet: waiting for {names}")
        if result is None or self._cells is None:
            return
        count = len(result.sites.score)
        status.add(
            {
                "map.stamp_ns": result.stamp_ns,
                "map.leaves": len(self._cells.level),
                "sites": count,
                "explanation": result.explanation,
            }
        )
        if self._inputs.withheld:
            return
        if count:
            status.note(OK, f"{count} sites; {result.explanation}")
        else:
            reason = result.explanation.removeprefix("no safe site: ")
            status.note(WARN, f"no safe site: {reason}")


def main(args: Sequence[str] | None = None) -> int:
    """Console script ``lss_node``."""
    return run(LssNode, "lss_node: the map to hazards and ranked landing sites", args)
