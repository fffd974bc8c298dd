# SPDX-License-Identifier: Apache-2.0
"""Inputs of one step of the landing: the vehicle, the target, contact with the ground."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.landing.target import Reason, State
from quadtree_lss.onboard.messages.poses import MAX_POSITION

POSE_S = 0.5
"""Maximum age of a pose, by its stamp; with an older one the vehicle holds. Poses come at 50 Hz."""
NEAR_M = 0.5
"""Height above or below the expected ground within which one report of contact is sufficient:
height of the body on its legs plus the error of navigation's height."""
STILL_M_S = 0.5
"""Upper speed limit of a vehicle on the ground; following a set-point 1 m lower is faster."""
STILL_M, STILL_S = 0.2, 2.0
"""A vehicle that moves less than this distance in this time stands still; ten reports at 5 Hz."""
COMMANDED_M = 0.5
"""Distance of a set-point that moves a vehicle in the air."""
OFFSET_M = 0.5
"""Horizontal distance from the target up to which the vehicle descends; it commits within half of
it, and a target that moves farther is a different one. Four times ArduCopter's largest landing
error (``docs/evidence.md``)."""
DRIFT_M_S = 0.1
"""Largest drift of a barometer relative to the map."""
REASONS = {int(reason): reason.key for reason in Reason}


class Target(NamedTuple):
    """Location at which to land: ``place`` (3,) in the map, with the height of navigation, m."""

    place: Array
    age: float  # time since the target was last received, s
    map_age: float  # time since the newest scan of its map, s; NaN if unknown
    offset: float  # height of navigation minus that of the map, in `place`, m; NaN if unknown


def target_from_status(
    place: Array, status: np.void, age: float, status_age: float
) -> tuple[Target | None, str]:
    """Return the target of lss_node and "", or None and the reason why there is none. ``place``,
    ``status``: position of ``landing/selected``, and record of ``landing/status``; ``age``: time
    since the older of the two messages was received, s; ``status_age``: since ``status`` was."""
    offset = float(status["offset_z"])
    place = place + (0.0, 0.0, offset if math.isfinite(offset) else 0.0)
    if not (np.abs(place) <= MAX_POSITION).all():
        return None, f"there is no target: {REASONS.get(int(status['reason']), 'unknown')}"
    # A vehicle that has to land now uses the map at any age.
    map_age = 0.0 if status["state"] == State.NOW else float(status["age"]) + status_age
    return Target(place, age, map_age, offset), ""


class Inputs(NamedTuple):
    """Inputs of one step, as reported by the autopilot; times in s."""

    now: float  # of a steady clock
    accepts_set_points: bool
    armed: bool
    landed: bool | None  # None without a recent report
    landed_for: float  # time since `landed` changed
    heartbeat_age: float
    pose_age: float  # by its stamp
    position: Array  # (3,) in the map, m
    velocity: Array  # (3,) in the map, m/s
    jump: float  # of the position since the last step, m
    target: Target | None
    why: str  # the reason why there is no target


class GroundContact:
    """Check the autopilot's "on the ground" against the vehicle's motion.

    Attributes:
        made: Contact is confirmed: near the expected ground, or no motion for ``STILL_S`` although
            a set-point commanded it.
        rests: The vehicle stands still at ``place``; without a commanded motion it may hover.
        refuted: The vehicle is armed and moves.

    All three are reset when the autopilot reports "in the air" or stops reporting.
    """

    def __init__(self) -> None:
        self._reset()

    def _reset(self) -> None:
        self.made = self.rests = self.refuted = False
        self.place: Array | None = None
        self._since = self._not_commanded = 0.0

    def update(self, inputs: Inputs, ground_z: float | None, set_point: Array | None) -> None:
        """Process the inputs of one step. ``ground_z``: expected height of the ground, m;
        ``set_point``: the last one (3,); None if unknown."""
        if not inputs.landed:
            self._reset()
            return
        position, now = inputs.position, inputs.now
        slow = float(np.linalg.norm(inputs.velocity)) <= STILL_M_S
        near = ground_z is not None and abs(position[2] - ground_z) <= NEAR_M
        self.made |= near and slow
        self.refuted |= inputs.armed and not slow and not self.made
        moved = self.place is None or float(np.linalg.norm(position - self.place)) > STILL_M
        if moved or inputs.pose_age > POSE_S or inputs.landed_for < now - self._since:
            self.place, self._since, self._not_commanded = position.copy(), now, now
        if set_point is None or float(np.linalg.norm(set_point - position)) < COMMANDED_M:
            self._not_commanded = now
        self.made |= now - self._not_commanded >= STILL_S
        self.refuted &= not self.made
        self.rests = not self.refuted and now - self._since >= STILL_S


class MapHeight:
    """Track the height offset between navigation and map, which drifts but does not jump."""

    def __init__(self) -> None:
        self._last_step = 0.0
        self._offset = math.nan
        self._place: Array | None = None

    def shift(self, now: float, target: Target) -> float:
        """Return the height change of the target, or of the whole map, that drift does not explain,
        m."""
        drift = DRIFT_M_S * max(now - self._last_step, 0.0)
        self._last_step = now
        change = target.offset - self._offset
        if not math.isfinite(change):
            self._offset, change = target.offset, 0.0
        self._offset += min(max(change, -drift), drift)
        if self._place is None or np.hypot(*(target.place - self._place)[:2]) > OFFSET_M:
            self._place = target.place.copy()
        rise = float(target.place[2] - self._place[2])
        self._place[2] += min(max(rise, -drift), drift)
        return max(abs(change), abs(rise))
