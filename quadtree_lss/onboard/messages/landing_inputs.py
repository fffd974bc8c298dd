# SPDX-License-Identifier: Apache-2.0
"""What guidance says: ``landing/area``, ``keep_out``, ``target`` and ``dispersion``."""

from __future__ import annotations

from typing import Any

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.geometry.polygons import FARTHEST
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.poses import check_frame

AREA, KEEP_OUT, TARGET, DISPERSION = "area", "keep_out", "target", "dispersion"
"""Their topics are ``landing/`` and this."""

POLYGON_TYPE, POINT_TYPE = "geometry_msgs/msg/PolygonStamped", "geometry_msgs/msg/PointStamped"
DISPERSION_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TYPES = {
    AREA: POLYGON_TYPE,
    KEEP_OUT: POLYGON_TYPE,
    TARGET: POINT_TYPE,
    DISPERSION: DISPERSION_TYPE,
}

BINDING = (AREA, KEEP_OUT)
"""Topics without regard to which no site may be given out."""

KNOWN_HEADING, WIDEST = np.radians(15.0), 100.0
"""Deviation of a heading that counts as known, rad; greatest deviation of a touchdown, m."""

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


def dispersion_from_message(msg: Any, map_frame: str) -> Array | None:
    """Deviations along x and y, m, and heading, rad, if it is known; None if there are none.

    Of the covariance the variances in x and y count, and that of the rotation about z: a heading
    that is not known to 15 degrees is any. The position means nothing.

    Raises:
        MessageError: with reason ``frame`` or ``dispersion``.
    """
    check_frame(msg.header.frame_id, map_frame, "dispersion")
    covariance = np.asarray(msg.pose.covariance, dtype=np.float64)
    variance = covariance[[0, 7]] if covariance.size == 36 else np.full(2, -1.0)
    if np.isnan(variance).all():
        return None
    if not ((variance >= 0.0) & (variance <= WIDEST**2)).all():
        text = f"variances {variance.tolist()} m^2 are not those of at most {WIDEST:g} m"
        raise MessageError("dispersion", text)
    q, known = msg.pose.pose.orientation, 0.0 <= covariance[35] <= KNOWN_HEADING**2
    x, y, z, w = (float(of) for of in (q.x, q.y, q.z, q.w))
    turned = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.append(np.sqrt(variance), turned if known and np.isfinite(turned) else [])


DECODE = {
    AREA: polygon_from_message,
    KEEP_OUT: polygon_from_message,
    TARGET: target_from_message,
    DISPERSION: dispersion_from_message,
}


class LandingWishes:
    """What was asked for last, as `assess` takes it.

    An area or a keep-out that was sent and cannot be used could be anywhere: no site may be given
    out then. Of a target or dispersion that cannot be used the one before holds; it only makes
    sites better.

    Args:
        frame: Of the map; None as long as it is not known: any frame will do.
        fixed: Values (V, 2), (2,) or None by name that no message changes.

    Attributes:
        values: What holds by name, None if nothing was asked for.
        unusable: Why the last message of a name cannot be used, where it cannot.
        heard: The last message by name.
    """

    def __init__(self, frame: str | None, fixed: dict[str, Array | None] | None = None) -> None:
        self._frame = frame
        self.fixed = dict(fixed or {})
        self.values: dict[str, Array | None] = dict.fromkeys(TYPES) | self.fixed
        self.unusable: dict[str, str] = {}
        self.heard: dict[str, Any] = {}

    def take(self, name: str, msg: Any) -> None:
        """A message of the topic ``landing/`` and this name.

        Raises:
            MessageError: it cannot be used.
        """
        if name in self.fixed:
            return
        self.heard[name] = msg
        self.unusable.pop(name, None)
        frame = msg.header.frame_id if self._frame is None else self._frame
        try:
            self.values[name] = DECODE[name](msg, frame)
        except MessageError as error:
            self.refuse(name, error)
            raise

    def use_frame(self, frame: str) -> dict[str, MessageError]:
        """The map is in this frame: what was heard counts for it or not; what is wrong, by name."""
        wrong: dict[str, MessageError] = {}
        if frame != self._frame:
            self._frame = frame
            for name, msg in self.heard.items():
                self.values[name] = None
                try:
                    self.take(name, msg)
                except MessageError as error:
                    wrong[name] = error
        return wrong

    def refuse(self, name: str, error: MessageError) -> None:
        """A message of this name cannot be used."""
        if name not in self.fixed:
            self.unusable[name] = f"landing/{name} cannot be used: {error}"
            if name in BINDING:
                self.values[name] = None

    @property
    def withheld(self) -> str:
        """Why no site may be given out, empty if nothing speaks against it."""
        return "; ".join(self.unusable[name] for name in BINDING if name in self.unusable)

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of ``LandingSiteSelector.assess``."""
        return {**self.values, "withheld": self.withheld}

    def as_lists(self) -> dict[str, Any]:
        """Those that hold, for a summary."""
        return {name: v.tolist() for name, v in self.values.items() if v is not None}
