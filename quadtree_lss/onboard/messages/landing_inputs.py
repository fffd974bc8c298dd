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
"""Names of the topics, without ``landing/``."""

POLYGON_TYPE, POINT_TYPE = "geometry_msgs/msg/PolygonStamped", "geometry_msgs/msg/PointStamped"
INSTANCE_TYPE = "geometry_msgs/msg/PolygonInstanceStamped"
TYPES = {
    AREA: POLYGON_TYPE,
    KEEP_OUT: POLYGON_TYPE,
    KEEP_OUTS: INSTANCE_TYPE,
    TARGET: POINT_TYPE,
    DISPERSION: "geometry_msgs/msg/PoseWithCovarianceStamped",
}

BINDING = (AREA, KEEP_OUT, KEEP_OUTS)
"""Topics that restrict landing: while one is unusable, no site is published."""

MAX_HEADING_SIGMA, MAX_TOUCHDOWN_SIGMA = np.radians(15.0), 100.0
"""Maximum standard deviation of a known heading, rad, and of a touchdown, m."""

MAX_VERTICES, MAX_FRAME_LENGTH = 1000, 256
"""Limits of a polygon's vertices, and of the characters stored of a frame's name."""

MAX_LISTED = 3
"""Limit of the unusable inputs listed in one message."""

SPEED_S = 0.5
"""Time over which the vehicle's speed is measured, s."""

MAX_KEEP_OUTS = 200
"""Limit of the keep-outs of the set; more are rejected."""


def polygon_from_message(msg: Any) -> Array | None:
    """Return vertices (V, 2), m; None for a message without any: no restriction. Raises
    `MessageError` with reason ``polygon``."""
    polygon = getattr(msg.polygon, "polygon", msg.polygon)  # PolygonInstanceStamped nests it
    corners = np.array([(p.x, p.y) for p in polygon.points], dtype=np.float64)
    if not len(corners):
        return None
    if not 3 <= len(corners) <= MAX_VERTICES or not (np.abs(corners) <= MAX_COORDINATE).all():
        text = f"polygon of {len(corners)} vertices is not usable: 3 to {MAX_VERTICES} finite ones"
        text += f" within {MAX_COORDINATE:g} m, or none to lift the restriction"
        raise MessageError("polygon", text)
    return corners


def target_from_message(msg: Any) -> Array | None:
    """Return a position (2,), m; None if x and y are both NaN: no target. Raises `MessageError`
    with reason ``point``."""
    position = np.array([msg.point.x, msg.point.y], dtype=np.float64)
    if np.isnan(position).all():
        return None
    if not (np.abs(position) <= MAX_COORDINATE).all():
        text = f"target ({position[0]:g}, {position[1]:g}) is not finite or too far away"
        raise MessageError("point", text)
    return position


def dispersion_from_message(msg: Any) -> Array | None:
    """Return the standard deviations along x and y, m, and the heading, rad, if that is known;
    None if the variances are NaN. Raises `MessageError` with reason ``dispersion``."""
    covariance = np.asarray(msg.pose.covariance, dtype=np.float64)
    variance = covariance[[0, 7]] if covariance.size == 36 else np.full(2, -1.0)
    if np.isnan(variance).all():
        return None
    if not ((variance >= 0.0) & (variance <= MAX_TOUCHDOWN_SIGMA**2)).all():
        limit = f"({MAX_TOUCHDOWN_SIGMA:g} m)^2"
        text = f"variances {variance.tolist()} m^2 are not within 0 and {limit}"
        raise MessageError("dispersion", text)
    q, known = msg.pose.pose.orientation, 0.0 <= covariance[35] <= MAX_HEADING_SIGMA**2
    x, y, z, w = map(float, (q.x, q.y, q.z, q.w))
    along, across = w * w + x * x - y * y - z * z, 2.0 * (w * z + x * y)  # of any length
    known &= 0.0 < np.hypot(along, across) < np.inf
    return np.append(np.sqrt(variance), np.arctan2(across, along) if known else [])


DECODE = {
    **dict.fromkeys(BINDING, polygon_from_message),
    TARGET: target_from_message,
    DISPERSION: dispersion_from_message,
}


class LandingRequests:
    """The current restrictions and targets, as arguments of `assess`.

    While an area or keep-out is unusable, no site is published, because it could be anywhere. An
    unusable target or dispersion leaves the previous value. ``frame`` of the map is None while
    unknown: any is accepted. No message changes the values ``fixed``; ``keep_outs`` is a list.

    Attributes:
        values: Current value by name, None without one; ``keep_outs/<id>`` is one of the set.
        unusable: Why the last message of a name is unusable.
        last_messages: Frame, and content or error, of the last message by name.
    """

    def __init__(self, frame: str | None, fixed: Mapping[str, Any] | None = None) -> None:
        self._frame = frame
        self.fixed = dict(fixed or {})
        single = (name for name in TYPES if name != KEEP_OUTS)
        self.values: dict[str, Array | None] = dict.fromkeys(single) | self.fixed
        for number, polygon in enumerate(self.values.pop(KEEP_OUTS, None) or (), 1):
            self.values[f"{KEEP_OUTS}/{number}"] = polygon
        self.unusable: dict[str, str] = {}
        self.last_messages: dict[str, tuple[str, Array | MessageError | None]] = {}
        self.navigation = Navigation()

    def use_message(self, topic: str, msg: Any) -> None:
        """Use a message of ``landing/<topic>``. Raises `MessageError`: it is unusable."""
        if topic in self.fixed:
            return
        name = name_of(topic, msg)
        full = topic == KEEP_OUTS and name not in self.last_messages
        full &= sum(topic_of(other) == KEEP_OUTS for other in self.last_messages) >= MAX_KEEP_OUTS
        frame = str(msg.header.frame_id)[:MAX_FRAME_LENGTH]
        content: Array | MessageError | None
        try:
            content = DECODE[topic](msg)
        except MessageError as error:  # its traceback would keep the message alive
            content = MessageError(error.reason, str(error))
        if full and content is not None:
            content = MessageError("number", f"there are {MAX_KEEP_OUTS} already")
        if not full:
            self.last_messages[name] = frame, content
        self._use(name, frame, content)

    def _use(self, name: str, frame: str, content: Array | MessageError | None) -> None:
        topic = topic_of(name)
        try:
            what = "polygon" if topic in BINDING else topic
            check_frame(frame, frame if self._frame is None else self._frame, what)
            if isinstance(content, MessageError):
                raise MessageError(content.reason, str(content))
        except MessageError as error:
            self.mark_unusable(name, error)
            raise
        self.values[name] = content
        self.unusable.pop(name, None)
        if topic == KEEP_OUTS and content is None and self._frame is not None:
            del self.values[name]
            self.last_messages.pop(name, None)

    def use_frame(self, frame: str) -> dict[str, MessageError]:
        """Check all messages against the frame of the map; return the errors by name."""
        errors: dict[str, MessageError] = {}
        if frame != self._frame:
            self._frame = frame
            for name, message in list(self.last_messages.items()):
                self.values[name] = None
                try:
                    self._use(name, *message)
                except MessageError as error:
                    errors[name] = error
        return errors

    def mark_unusable(self, name: str, error: MessageError) -> None:
        """Record that the last message of a name is unusable."""
        known = name in self.unusable or len(self.unusable) < 2 * MAX_KEEP_OUTS
        if known and topic_of(name) not in self.fixed:
            self.unusable[name] = f"landing/{name} cannot be used: {error}"
            if topic_of(name) in BINDING:
                self.values[name] = None

    @property
    def why_withheld(self) -> str:
        """Return why no site may be published, empty if one may."""
        reasons = [text for name, text in self.unusable.items() if topic_of(name) in BINDING]
        more = len(reasons) - MAX_LISTED
        return "; ".join(reasons[:MAX_LISTED] + ([f"and {more} more"] if more > 0 else []))

    def arguments(self) -> dict[str, Any]:
        """Return keyword arguments of ``LandingSiteSelector.assess``."""
        single: dict[str, Any] = {n: self.values[n] for n in (AREA, TARGET, DISPERSION)}
        keep_outs = [v for name, v in self.values.items() if name not in single and v is not None]
        single |= {KEEP_OUTS: keep_outs, "why_withheld": self.why_withheld}
        return {**single, "vehicle": self.navigation.vehicle(self._frame or "")}

    def as_lists(self) -> dict[str, Any]:
        return {k: np.asarray(v).tolist() for k, v in self.values.items() if v is not None}


class Navigation:
    """Position and speed of the vehicle from its poses; ``known`` after the first usable one."""

    def __init__(self) -> None:
        self.known = False
        self._frame: str | None = None
        self._vehicle: Motion | None = None
        self._start = (0, np.full(3, np.nan))  # of the speed: stamp, ns, and position

    def use_pose(self, msg: Any) -> bool:
        """Use a ``PoseWithCovarianceStamped`` or ``Odometry``; return whether it is usable."""
        p = msg.pose.pose.position
        position = np.array([p.x, p.y, p.z], dtype=np.float64)
        now = 10**9 * msg.header.stamp.sec + msg.header.stamp.nanosec
        if not (np.abs(position) <= MAX_COORDINATE).all():
            return False
        x, y, z = position.tolist()
        before, self._frame = self._frame, str(msg.header.frame_id).lstrip("/")
        seconds = 1e-9 * (now - self._start[0])
        continues = before == self._frame and 0.0 <= seconds < 5.0 * SPEED_S
        if not continues:  # first pose, new frame, or time jump
            self._start, self._vehicle = (now, position), Motion(z, 0.0, x, y)
        elif seconds >= SPEED_S:
            along_x, along_y, up = ((position - self._start[1]) / seconds).tolist()
            self._vehicle = Motion(z, -up, x, y, along_x, along_y)
            self._start = now, position
        elif self._vehicle is not None:
            self._vehicle = self._vehicle._replace(z=z, x=x, y=y)
        self.known = True
        return True

    def vehicle(self, frame: str) -> Motion | None:
        """Return the motion in a frame, None if unknown."""
        return self._vehicle if self._frame == frame.lstrip("/") else None


def name_of(topic: str, msg: Any) -> str:
    """Return the name of the value that a message sets."""
    return f"{topic}/{msg.polygon.id}" if topic == KEEP_OUTS else topic


def topic_of(name: str) -> str:
    return name.partition("/")[0]
