# SPDX-License-Identifier: Apache-2.0
"""What guidance says: ``landing/area``, keep-outs, ``target`` and ``dispersion``; where it is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.geometry.polygons import FARTHEST
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
"""Topics without regard to which no site may be given out."""

KNOWN_HEADING, WIDEST = np.radians(15.0), 100.0
"""Deviation of a heading that counts as known, rad; greatest deviation of a touchdown, m."""

MAX_VERTICES, LONGEST_NAME = 1000, 256
"""More are taken for a damaged message; so much is kept of the name of a frame."""

TOLD = 3
"""So many inputs that cannot be used are named in a line."""

SPEED_S = 0.5
"""Over which the vehicle's speed is taken."""

MAX_KEEP_OUTS = 200
"""Of the set; another one is refused."""


def polygon_from_message(msg: Any, map_frame: str) -> Array | None:
    """Vertices (V, 2) in the map frame, m; None if the message has none: no restriction. Raises
    `MessageError`: with reason ``frame`` or ``polygon``."""
    check_frame(msg.header.frame_id, map_frame, "polygon")
    polygon = getattr(msg.polygon, "polygon", msg.polygon)  # of one of a set, which has an id
    corners = np.array([(p.x, p.y) for p in polygon.points], dtype=np.float64)
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
    """Place (2,) in the map frame, m; None if x and y are both NaN: no target. Raises
    `MessageError`: with reason ``frame`` or ``point``."""
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
"""What a message of a topic is called."""


class LandingWishes:
    """What was asked for last, as `assess` takes it.

    An area or a keep-out that was sent and cannot be used could be anywhere: no site may be given
    out then. Of a target or dispersion that cannot be used the one before holds; it only makes
    sites better. Each keep-out of the set has a name of its own, ``keep_outs/`` and its id.

    Args:
        frame: Of the map; None as long as it is not known: any frame will do.
        fixed: Values (V, 2), (2,) or None by name that no message changes; of ``keep_outs`` a list.

    Attributes:
        values: What holds by name, None if nothing was asked for.
        unusable: Why the last message of a name cannot be used, where it cannot.
        heard: The last message by name: its frame, and its content or why that is unusable.
        navigation: Of the vehicle.
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
        """A message of the topic ``landing/`` and this name. Raises `MessageError`: it cannot be
        used."""
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
        """The map is in this frame: what was heard counts for it or not; what is wrong, by name."""
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
        """A message of this name cannot be used."""
        known = name in self.unusable or len(self.unusable) < 2 * MAX_KEEP_OUTS
        if known and topic_of(name) not in self.fixed:
            self.unusable[name] = f"landing/{name} cannot be used: {error}"
            if topic_of(name) in BINDING:
                self.values[name] = None

    @property
    def withheld(self) -> str:
        """Why no site may be given out, empty if nothing speaks against it."""
        whys = [why for name, why in self.unusable.items() if topic_of(name) in BINDING]
        more = len(whys) - TOLD
        return "; ".join(whys[:TOLD] + ([f"and {more} more"] if more > 0 else []))

    def arguments(self) -> dict[str, Any]:
        """Keyword arguments of ``LandingSiteSelector.assess``."""
        single = {name: v for name, v in self.values.items() if topic_of(name) == name}
        many = [v for k, v in self.values.items() if k not in single and v is not None]
        vehicle = self.navigation.vehicle(self._frame or "")
        return {**single, KEEP_OUTS: many, "withheld": self.withheld, "vehicle": vehicle}

    def as_lists(self) -> dict[str, Any]:
        """Those that hold, for a summary."""
        return {k: np.asarray(v).tolist() for k, v in self.values.items() if v is not None}


class Navigation:
    """Place and speed of the vehicle by its poses, on which its reach depends."""

    def __init__(self) -> None:
        self._frame: str | None = None
        self._vehicle: Motion | None = None
        self._from = (0, np.full(3, np.nan))

    def take(self, msg: Any) -> bool:
        """A ``PoseWithCovarianceStamped`` or ``Odometry``; what is no height is passed over.
        Whether it was taken."""
        at = msg.pose.pose.position
        place = np.array([at.x, at.y, at.z], dtype=np.float64)
        now = 10**9 * msg.header.stamp.sec + msg.header.stamp.nanosec
        if not (np.abs(place) <= FARTHEST).all():
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
        """Whether there was a place in any frame."""
        return self._vehicle is not None

    def vehicle(self, frame: str) -> Motion | None:
        """In a frame; None if nobody knows."""
        return self._vehicle if self._frame == frame.lstrip("/") else None


def name_of(topic: str, msg: Any) -> str:
    """Of what a message sets: of a set, each id has its own."""
    return f"{topic}/{msg.polygon.id}" if topic == KEEP_OUTS else topic


def topic_of(name: str) -> str:
    """Without the id of one of a set."""
    return name.partition("/")[0]
