# SPDX-License-Identifier: Apache-2.0
"""Inputs from guidance: ``landing/area``, keep-outs, ``target``, ``dispersion`` and poses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.geometry.polygons import MAX_COORDINATE
from quadtree_lss.onboard.core.landing.target import Motion
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.poses import check_frame

AREA, KEEP_OUT, TARGET, DISPERSION = "area", "keep_out", "target", "dispersion"
KEEP_OUTS = "keep_outs"
"""Their topics are ``landing/`` and this."""

POLYGON_TYPE, POINT_TYPE = "geometry_msgs/msg/PolygonStamped", "geometry_msgs/msg/PointStamped"
INSTANCE_TYPE = "geometry_msgs/msg/PolygonInstanceStamped"
DISPERSION_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TYPES = {
    AREA: POLYGON_TYPE,
    KEEP_OUT: POLYGON_TYPE,
    KEEP_OUTS: INSTANCE_TYPE,
    TARGET: POINT_TYPE,
    DISPERSION: DISPERSION_TYPE,
}

BINDING = (AREA, KEEP_OUT, KEEP_OUTS)
"""Topics that must be respected: without them no site is published."""

KNOWN_HEADING, WIDEST = np.radians(15.0), 100.0
"""Greatest standard deviation of a known heading, rad, and of a touchdown, m."""

MAX_VERTICES, LONGEST_NAME = 1000, 256
"""Most vertices of a polygon; characters that are kept of a frame's name."""

TOLD = 3
"""Most unusable inputs that a line names."""

SPEED_S = 0.5
"""Time over which the vehicle's speed is measured."""

MAX_KEEP_OUTS = 200
"""Most keep-outs of the set; others are rejected."""


def polygon_from_message(msg: Any, map_frame: str) -> Array | None:
    """Vertices (V, 2) in the map frame, m; None if the message has none: no restriction. Raises
    `MessageError`: with reason ``frame`` or ``polygon``."""
    check_frame(msg.header.frame_id, map_frame, "polygon")
    polygon = getattr(msg.polygon, "polygon", msg.polygon)  # of one of a set, which has an id
    corners = np.array([(p.x, p.y) for p in polygon.points], dtype=np.float64)
    if not len(corners):
        return None
    if not 3 <= len(corners) <= MAX_VERTICES or not (np.abs(corners) <= MAX_COORDINATE).all():
        text = (
            f"polygon of {len(corners)} vertices is not usable: 3 to {MAX_VERTICES} finite ones"
            f" within {MAX_COORDINATE:g} m, or none to lift the restriction"
        )
        raise MessageError("polygon", text)
    return corners


def target_from_message(msg: Any, map_frame: str) -> Array | None:
    """Place (2,) in the map frame, m; None if x and y are both NaN: no target. Raises
    `MessageError`: with reason ``frame`` or ``point``."""
    check_frame(msg.header.frame_id, map_frame, "target")
    place = np.array([msg.point.x, msg.point.y], dtype=np.float64)
    if np.isnan(place).all():
        return None
    if not (np.abs(place) <= MAX_COORDINATE).all():
        text = f"target ({place[0]:g}, {place[1]:g}) is not finite or not of this world"
        raise MessageError("point", text)
    return place


def dispersion_from_message(msg: Any, map_frame: str) -> Array | None:
    """Deviations along x and y, m, and heading, rad, if it is known; None if there are none.

    Of the covariance the variances in x and y count, and that of the rotation about z: a heading
    that is not known to 15 degrees is any. The position means nothing. Raises `MessageError`: with
    reason ``frame`` or ``dispersion``."""
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
    along, across = w * w + x * x - y * y - z * z, 2.0 * (w * z + x * y)  # whatever its length
    known &= 0.0 < np.hypot(along, across) < np.inf
    return np.append(np.sqrt(variance), np.arctan2(across, along) if known else [])


DECODE = {
    AREA: polygon_from_message,
    KEEP_OUT: polygon_from_message,
    KEEP_OUTS: polygon_from_message,
    TARGET: target_from_message,
    DISPERSION: dispersion_from_message,
}
WHAT = {topic: topic for topic in TYPES} | dict.fromkeys((AREA, KEEP_OUT, KEEP_OUTS), "polygon")
"""Noun for a message of each topic, in error texts."""


class LandingRequests:
    """The restrictions of the last messages, as arguments of `assess`.

    An unusable area or keep-out could be anywhere, so no site is published. An unusable target or
    dispersion leaves the one before. Each keep-out of the set is named ``keep_outs/`` and its id.

    Args:
        frame: Frame of the map; None while unknown: any frame is accepted.
        fixed: Values (V, 2), (2,) or None by name that no message changes; ``keep_outs`` is a list.

    Attributes:
        values: Current value by name, None without one.
        unusable: Why the last message of a name is unusable.
        heard: Last message by name: its frame, and its content or error.
        navigation: Motion of the vehicle.
    """

    def __init__(self, frame: str | None, fixed: Mapping[str, Any] | None = None) -> None:
        self._frame = frame
        self.fixed = dict(fixed or {})
        single = (name for name in TYPES if name != KEEP_OUTS)
        self.values: dict[str, Array | None] = dict.fromkeys(single) | self.fixed
        for number, polygon in enumerate(self.values.pop(KEEP_OUTS, None) or (), 1):
            self.values[f"{KEEP_OUTS}/{number}"] = polygon
        self.unusable: dict[str, str] = {}
        self.heard: dict[str, tuple[str, Array | MessageError | None]] = {}
        self.navigation = Navigation()

    def take(self, topic: str, msg: Any) -> None:
        """Use a message of ``landing/<topic>``. Raises `MessageError`: it is unusable."""
        if topic in self.fixed:
            return
        name = name_of(topic, msg)
        full = topic == KEEP_OUTS and name not in self.heard
        full &= sum(topic_of(of) == KEEP_OUTS for of in self.heard) >= MAX_KEEP_OUTS
        frame = str(msg.header.frame_id)[:LONGEST_NAME]
        content: Array | MessageError | None
        try:
            content = DECODE[topic](msg, msg.header.frame_id)
        except MessageError as error:  # which holds the message, by its traceback
            content = MessageError(error.reason, str(error))
        if full and content is not None:
            content = MessageError("number", f"there are {MAX_KEEP_OUTS} already")
        if not full:
            self.heard[name] = frame, content
        self._use(name, frame, content)

    def _use(self, name: str, frame: str, content: Array | MessageError | None) -> None:
        topic = topic_of(name)
        try:
            check_frame(frame, frame if self._frame is None else self._frame, WHAT[topic])
            if isinstance(content, MessageError):
                raise MessageError(content.reason, str(content))
        except MessageError as error:
            self.refuse(name, error)
            raise
        self.values[name] = content
        self.unusable.pop(name, None)
        if topic == KEEP_OUTS and content is None and self._frame is not None:
            del self.values[name]
            self.heard.pop(name, None)

    def use_frame(self, frame: str) -> dict[str, MessageError]:
        """Check all messages against the frame of the map; return the errors by name."""
        wrong: dict[str, MessageError] = {}
        if frame != self._frame:
            self._frame = frame
            for name, heard in list(self.heard.items()):
                self.values[name] = None
                try:
                    self._use(name, *heard)
                except MessageError as error:
                    wrong[name] = error
        return wrong

    def refuse(self, name: str, error: MessageError) -> None:
        """Record that the last message of a name is unusable."""
        known = name in self.unusable or len(self.unusable) < 2 * MAX_KEEP_OUTS
        if known and topic_of(name) not in self.fixed:
            self.unusable[name] = f"landing/{name} cannot be used: {error}"
            if topic_of(name) in BINDING:
                self.values[name] = None

    @property
    def withheld(self) -> str:
        """Return why no site may be published, empty if one may."""
        whys = [why for name, why in self.unusable.items() if topic_of(name) in BINDING]
        more = len(whys) - TOLD
        return "; ".join(whys[:TOLD] + ([f"and {more} more"] if more > 0 else []))

    def arguments(self) -> dict[str, Any]:
        """Return keyword arguments of ``LandingSiteSelector.assess``."""
        single = {name: self.values[name] for name in (AREA, TARGET, DISPERSION)}
        keep_outs = [v for name, v in self.values.items() if name not in single and v is not None]
        vehicle = self.navigation.vehicle(self._frame or "")
        return {**single, KEEP_OUTS: keep_outs, "withheld": self.withheld, "vehicle": vehicle}

    def as_lists(self) -> dict[str, Any]:
        """Return the current values for a summary."""
        return {k: np.asarray(v).tolist() for k, v in self.values.items() if v is not None}


class Navigation:
    """Position and speed of the vehicle from its poses."""

    def __init__(self) -> None:
        self._frame: str | None = None
        self._vehicle: Motion | None = None
        self._from = (0, np.full(3, np.nan))

    def take(self, msg: Any) -> bool:
        """Use a ``PoseWithCovarianceStamped`` or ``Odometry``; return whether it is usable."""
        at = msg.pose.pose.position
        place = np.array([at.x, at.y, at.z], dtype=np.float64)
        now = 10**9 * msg.header.stamp.sec + msg.header.stamp.nanosec
        if not (np.abs(place) <= MAX_COORDINATE).all():
            return False
        x, y, z = place.tolist()
        before, self._frame = self._frame, str(msg.header.frame_id).lstrip("/")
        seconds = 1e-9 * (now - self._from[0])
        goes_on = before == self._frame and 0.0 <= seconds < 5.0 * SPEED_S
        if not goes_on:  # the first one, of another frame, or after a time jump
            self._from, self._vehicle = (now, place), Motion(z, 0.0, x, y)
        elif seconds >= SPEED_S:
            along_x, along_y, up = ((place - self._from[1]) / seconds).tolist()
            self._vehicle = Motion(z, -up, x, y, along_x, along_y)
            self._from = now, place
        elif self._vehicle is not None:
            self._vehicle = self._vehicle._replace(z=z, x=x, y=y)
        return True

    @property
    def known(self) -> bool:
        """Whether any pose was usable."""
        return self._vehicle is not None

    def vehicle(self, frame: str) -> Motion | None:
        """Return the motion in a frame, None if unknown."""
        return self._vehicle if self._frame == frame.lstrip("/") else None


def name_of(topic: str, msg: Any) -> str:
    """Return the name of what a message sets: each id of a set has its own."""
    return f"{topic}/{msg.polygon.id}" if topic == KEEP_OUTS else topic


def topic_of(name: str) -> str:
    """Return the topic of a name."""
    return name.partition("/")[0]
