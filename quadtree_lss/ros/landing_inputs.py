# SPDX-License-Identifier: Apache-2.0
"""Where landing is wanted and where not: ``landing/area``, ``landing/keep_out``, ``…/target``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PolygonStamped
from numpy.typing import NDArray
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node

from quadtree_lss.messages.clouds import MessageError
from quadtree_lss.messages.poses import check_frame
from quadtree_lss.ros.problems import Problems
from quadtree_lss.ros.qos import latched, stream, subscribe

Array = NDArray[np.float64]

MAX_VERTICES = 1000
"""More are taken for a damaged message."""


def polygon_from_message(msg: Any, map_frame: str) -> Array | None:
    """Vertices (V, 2) in the map frame, m; None if the message has none: no restriction.

    Raises:
        MessageError: with reason ``frame`` or ``polygon``.
    """
    check_frame(msg.header.frame_id, map_frame, "polygon")
    corners = np.array([(p.x, p.y) for p in msg.polygon.points], dtype=np.float64)
    if not len(corners):
        return None
    if not 3 <= len(corners) <= MAX_VERTICES or not np.isfinite(corners).all():
        text = (
            f"polygon of {len(corners)} vertices is not usable: 3 to {MAX_VERTICES} finite ones,"
            " or none to lift the restriction"
        )
        raise MessageError("polygon", text)
    return corners


def target_from_message(msg: Any, map_frame: str) -> Array | None:
    """Place (2,) in the map frame, m; None if x and y are both NaN: no target.

    Raises:
        MessageError: with reason ``frame`` or ``point``.
    """
    check_frame(msg.header.frame_id, map_frame, "target")
    place = np.array([msg.point.x, msg.point.y], dtype=np.float64)
    if np.isnan(place).all():
        return None
    if not np.isfinite(place).all():
        text = f"target ({place[0]:g}, {place[1]:g}) is not finite"
        raise MessageError("point", text)
    return place


class LandingInputs:
    """Subscribes to the three topics and holds what came last.

    Each is subscribed to twice: latched, to get back after a restart what was sent before, and
    volatile, which matches publishers that keep nothing. Taking a message twice changes nothing.

    Args:
        node: Owner.
        frame: Gives the map's frame.
        problems: Where unusable messages are told; what was held is then kept.
        changed: Called after each change.

    Attributes:
        area, keep_out: (V, 2) or None.
        target: (2,) or None.
    """

    def __init__(
        self,
        node: Node,
        frame: Callable[[], str],
        problems: Problems,
        changed: Callable[[], None],
    ) -> None:
        self.area: Array | None = None
        self.keep_out: Array | None = None
        self.target: Array | None = None
        self._frame, self._problems, self._changed = frame, problems, changed
        for name, kind, decode in (
            ("area", PolygonStamped, polygon_from_message),
            ("keep_out", PolygonStamped, polygon_from_message),
            ("target", PointStamped, target_from_message),
        ):
            take = self._taker(name, decode)
            subscribe(node, kind, f"landing/{name}", take, stream(5, reliable=True))
            quiet = SubscriptionEventCallbacks(use_default_callbacks=False)
            node.create_subscription(
                kind, f"landing/{name}", take, latched(), event_callbacks=quiet
            )

    def _taker(self, name: str, decode: Callable[[Any, str], Array | None]) -> Any:
        def take(message: Any) -> None:
            try:
                value = decode(message, self._frame())
            except MessageError as error:
                self._problems.report(f"{name}_{error.reason}", f"landing/{name} not used: {error}")
                return
            if not np.array_equal(value, getattr(self, name)):
                setattr(self, name, value)
                self._changed()

        return take
