# SPDX-License-Identifier: Apache-2.0
"""Where landing is wanted and where not: messages of ``landing/area``, ``keep_out``, ``target``."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.geometry.polygons import FARTHEST
from quadtree_lss.messages.clouds import MessageError
from quadtree_lss.messages.poses import check_frame

Array = NDArray[np.float64]

AREA, KEEP_OUT, TARGET = "area", "keep_out", "target"
"""Their topics are ``landing/`` and this."""

POLYGON_TYPE, POINT_TYPE = "geometry_msgs/msg/PolygonStamped", "geometry_msgs/msg/PointStamped"
TYPES = {AREA: POLYGON_TYPE, KEEP_OUT: POLYGON_TYPE, TARGET: POINT_TYPE}

BINDING = (AREA, KEEP_OUT)
"""Topics without regard to which no site may be given out."""

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
    if not 3 <= len(corners) <= MAX_VERTICES or not (np.abs(corners) <= FARTHEST).all():
        text = (
            f"polygon of {len(corners)} vertices is not usable: 3 to {MAX_VERTICES} finite ones"
            f" within {FARTHEST:g} m, or none to lift the restriction"
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
    if not (np.abs(place) <= FARTHEST).all():
        text = f"target ({place[0]:g}, {place[1]:g}) is not finite or not of this world"
        raise MessageError("point", text)
    return place


class LandingWishes:
    """What was asked for last, as `assess` takes it; offline, where messages come in their order.

    As in `lss_node`: no site while the last area or keep-out cannot be used; of a target that
    cannot be used the one before holds.

    Args:
        frame: Of the map.
        fixed: Values (V, 2), (2,) or None by name that no message changes.
    """

    def __init__(self, frame: str, fixed: dict[str, Array | None] | None = None) -> None:
        self._frame = frame
        self.fixed = dict(fixed or {})
        self._values: dict[str, Array | None] = dict.fromkeys(TYPES) | self.fixed
        self._unusable: dict[str, str] = {}

    def take(self, name: str, msg: Any) -> None:
        """A message of the topic ``landing/`` and this name.

        Raises:
            MessageError: it cannot be used.
        """
        if name in self.fixed:
            return
        decode = target_from_message if name == TARGET else polygon_from_message
        self._unusable.pop(name, None)
        try:
            self._values[name] = decode(msg, self._frame)
        except MessageError as error:
            self.refuse(name, error)
            raise

    def refuse(self, name: str, error: MessageError) -> None:
        """A message of this name cannot be used."""
        if name in BINDING and name not in self.fixed:
            self._values[name] = None
            self._unusable[name] = f"landing/{name} cannot be used: {error}"

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of ``LandingSiteSelector.assess``."""
        return {**self._values, "withheld": "; ".join(self._unusable.values())}

    def as_lists(self) -> dict[str, Any]:
        """Those that hold, for a summary."""
        return {name: v.tolist() for name, v in self._values.items() if v is not None}
