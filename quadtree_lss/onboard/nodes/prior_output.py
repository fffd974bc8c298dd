# SPDX-License-Identifier: Apache-2.0
"""``map/prior`` and ``map/look_first``: what a node says of its prior. Nothing without one."""

from __future__ import annotations

from pathlib import Path

from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped
from rclpy.node import Node

from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.prior import Prior
from quadtree_lss.onboard.errors import QuadtreeLssError
from quadtree_lss.onboard.messages.outputs import LOOK_FIRST, PRIOR
from quadtree_lss.onboard.nodes.diagnostics import WARN, Problems, Status
from quadtree_lss.onboard.nodes.files import regular_file
from quadtree_lss.onboard.nodes.qos import advertise, latched
from quadtree_lss.onboard.nodes.ros_messages import message_maker


def node_prior(config: Config, problems: Problems) -> Prior | None:
    """``prior.file``; a file that cannot be used is a problem, and none."""
    if not config.prior.file:
        return None
    from quadtree_lss.onboard.elevation.prior_file import read_prior

    try:
        return read_prior(config, regular_file(Path(config.prior.file)))
    except QuadtreeLssError as error:
        problems.report("prior", f"prior.file: {error}; the map begins without")
        return None


class PriorOutput:
    """Says once where to look first, and with each map how far it lies from the prior."""

    def __init__(self, node: Node, config: Config, prior: Prior | None, mapper: Mapper) -> None:
        self._wanted, self._mapper = bool(config.prior.file), mapper
        self._maker = message_maker(config.frames.map)
        self._offset = None
        if prior is None:
            return
        from quadtree_lss.onboard.elevation.look_first import look_first

        self._offset = advertise(node, PoseWithCovarianceStamped, PRIOR, latched())
        self._first = advertise(node, PoseArray, LOOK_FIRST, latched())
        self._first.publish(self._maker.looks(look_first(prior, mapper.domain, config)))

    def publish(self, stamp_ns: int) -> None:
        """With a map of this stamp."""
        found = self._mapper.prior_offset
        if self._offset is not None and found is not None:
            self._offset.publish(self._maker.prior(found, stamp_ns))

    def collect(self, status: Status) -> None:
        """For the diagnostics."""
        found = self._mapper.prior_offset
        if found is not None:
            status.add({f"prior.{key}": value for key, value in found.values.items()})
            if found.doubt:
                status.note(WARN, found.doubt)
        elif self._wanted:
            status.note(WARN, "prior.file cannot be used: the map began without")
