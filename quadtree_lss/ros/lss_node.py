# SPDX-License-Identifier: Apache-2.0
"""The map in, ranked landing sites out. Computes nothing: the core does."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

from geometry_msgs.msg import PoseArray
from nav_msgs.msg import OccupancyGrid
from rclpy.node import Node
from sensor_msgs.msg import PointCloud2

from quadtree_lss.core.config import Config
from quadtree_lss.core.quadtree import CellMap
from quadtree_lss.core.sites import LandingSiteSelector
from quadtree_lss.messages.clouds import MessageError, stamp_ns
from quadtree_lss.messages.maps import MapMessageError
from quadtree_lss.ros.diagnostics import Diagnostics
from quadtree_lss.ros.messages import (
    landing_grids,
    map_from_messages,
    site_table_message,
    sites_message,
)
from quadtree_lss.ros.node_runner import run
from quadtree_lss.ros.parameters import NodeParameters
from quadtree_lss.ros.problems import Problems
from quadtree_lss.ros.qos import advertise, latched, subscribe
from quadtree_lss.ros.rate_limit import ChangePublisher


class LssNode(Node):
    """Subscribes to ``map/cells`` and ``map/observed``, publishes the ``landing/`` topics."""

    def __init__(self) -> None:
        super().__init__("lss_node", automatically_declare_parameters_from_overrides=True)
        config = NodeParameters(self, self._reconfigure).config
        self._selector = LandingSiteSelector(config)
        self._problems = Problems(self.get_logger())
        self._diagnostics = Diagnostics(self, config.publish.diagnostics_rate, self._problems)
        self._pair: dict[str, Any] = {}
        self._cells: CellMap | None = None
        self._frame = config.frames.map
        self._assessments = 0
        self._sites = advertise(self, PoseArray, "landing/sites", latched())
        self._table = advertise(self, PointCloud2, "landing/site_table", latched())
        self._hazards = advertise(self, OccupancyGrid, "landing/hazards", latched())
        self._score = advertise(self, OccupancyGrid, "landing/score", latched())
        self._output = ChangePublisher(self, config.publish.lss_rate, self._assess)
        subscribe(self, PointCloud2, "map/cells", self._on_cells, latched())
        subscribe(self, OccupancyGrid, "map/observed", self._on_observed, latched())

    def _reconfigure(self, config: Config) -> None:
        self._selector = LandingSiteSelector(config)
        if self._cells is not None:
            self._output.changed()

    def _on_cells(self, message: Any) -> None:
        self._pair["cells"] = message
        self._join()

    def _on_observed(self, message: Any) -> None:
        self._pair["observed"] = message
        self._join()

    def _join(self) -> None:
        """A map is complete when both its messages carry the same stamp."""
        cells, observed = self._pair.get("cells"), self._pair.get("observed")
        if cells is None or observed is None:
            return
        try:
            if stamp_ns(cells.header) != stamp_ns(observed.header):
                return
            self._cells = map_from_messages(cells, observed)
        except (MapMessageError, MessageError) as error:
            self._problems.report(f"map.{error.reason}", f"map not used: {error}")
            return
        self._frame = cells.header.frame_id
        self._output.changed()

    def _assess(self) -> None:
        if self._cells is None:
            return
        start = time.perf_counter()
        result = self._selector.assess(self._cells)
        lss_ms = 1e3 * (time.perf_counter() - start)
        hazards, score = landing_grids(result, self._frame)
        self._hazards.publish(hazards)
        self._score.publish(score)
        self._table.publish(site_table_message(result, self._frame))
        self._sites.publish(sites_message(result, self._frame))
        self._assessments += 1
        values = {
            "assessments": self._assessments,
            "map.stamp_ns": result.stamp_ns,
            "map.leaves": len(self._cells.level),
            "lss_ms": f"{lss_ms:.1f}",
            "sites": len(result.sites.score),
            "explanation": result.explanation,
        }
        none = len(result.sites.score) == 0
        text = f"no safe site: {result.explanation}" if none else "ranking sites"
        self._diagnostics.set(text, values, warn=none)


def main(args: Sequence[str] | None = None) -> int:
    """Console script ``lss_node``."""
    return run(LssNode, "lss_node: the map to hazards and ranked landing sites", args)
