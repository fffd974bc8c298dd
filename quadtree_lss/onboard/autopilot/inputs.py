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
"""With an older pose, by its stamp, the vehicle only holds: they are asked for at 50 Hz."""
NEAR_M = 0.5
"""Within this height of the expected ground one report of contact is enough: the height of a body
on its legs, and the error of navigation's height."""
STILL_M_S = 0.5
"""A vehicle on the ground is slower; one that follows a set-point 1 m below it is faster."""
STILL_M, STILL_S = 0.2, 2.0
"""A vehicle that moves less than this for so long stands still; ten reports at 5 Hz."""
COMMANDED_M = 0.5
"""A set-point so far away moves a vehicle that is in the air."""
OFFSET_M = 0.5
"""The vehicle descends only so near beside the target, and commits within half of it; a target that
moves farther is another one. Four times what ArduCopter misses one by (``docs/evidence.md``)."""
DRIFT_M_S = 0.1
"""Drift of a barometer against the map."""
REASONS = {int(reason): reason.key for reason in Reason}


class Target(NamedTuple):
    """Where to land.

    Attributes:
        place: (3,) in the map by navigation's height, m.
        age: Since it was last said, s.
        map_age: Since the newest scan of its map, s; NaN if that cannot be known.
        offset: Height of navigation over the map's, in ``place``, m; NaN if it is not known.
    """

    place: Array
    age: float
    map_age: float
    offset: float


def target_from_status(
    place: Array, status: np.void, age: float, since: float
) -> tuple[Target | None, str]:
    """What lss_node says, by navigation's height; else why there is none. ``place``: (3,) of
    ``landing/selected``. ``status``: the record of ``landing/status``. ``age``, ``since``: of the
    older of the two, and since the latter came, s."""
    offset = float(status["offset_z"])
    place = place + (0.0, 0.0, offset if math.isfinite(offset) else 0.0)
    if not (np.abs(place) <= MAX_POSITION).all():
        return None, f"there is no target: {REASONS.get(int(status['reason']), 'unknown')}"
    # Who has to land now, lands by the map that there is.
    map_age = 0.0 if status["state"] == State.NOW else float(status["age"]) + since
    return Target(place, age, map_age, offset), ""


class Inputs(NamedTuple):
    """What is known at a moment.

    Attributes:
        now: Of a steady clock, s.
        accepts_set_points: Whether the autopilot is in the mode in which it follows set-points.
        armed: As it says.
        landed: Whether it says that it is on the ground; None if it has not said so lately.
        landed_for: Since when it has not said anything else, s.
        heartbeat_age, pose_age: Since the last heartbeat and the last pose's stamp, s.
        position, velocity: (3,) in the map, m and m/s.
        jump: By which navigation's place jumped since the last step, m.
        target: None while there is none.
        why: Why there is none.
    """

    now: float
    accepts_set_points: bool
    armed: bool
    landed: bool | None
    landed_for: float
    heartbeat_age: float
    pose_age: float
    position: Array
    velocity: Array
    jump: float
    target: Target | None
    why: str


class GroundContact:
    """Checks the autopilot's "on the ground" against the vehicle's motion.

    ``made`` becomes true near the expected ground, or once the vehicle has not moved for
    ``STILL_S`` although a set-point told it to. ``rests``: it stands still at ``place``, which
    proves nothing where no set-point tells it to move. ``refuted``: it is armed and moves. All
    three end when the autopilot says "in the air", or says nothing any more.
    """

    def __init__(self) -> None:
        self._reset()

    def _reset(self) -> None:
        self.made = self.rests = self.refuted = False
        self.place: Array | None = None
        self._since = self._not_commanded = 0.0

    def update(self, inputs: Inputs, ground_z: float | None, told: Array | None) -> None:
        """Judge one moment. ``ground_z``: the height at which ground is expected, m; ``told``: the
        last set-point, (3,); None for none."""
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
        if told is None or float(np.linalg.norm(told - position)) < COMMANDED_M:
            self._not_commanded = now
        self.made |= now - self._not_commanded >= STILL_S
        self.refuted &= not self.made
        self.rests = not self.refuted and now - self._since >= STILL_S


class MapHeight:
    """Follows the height of the map over navigation's, which drifts, but does not jump."""

    def __init__(self) -> None:
        self._last_step = 0.0
        self._offset = math.nan
        self._place: Array | None = None

    def shift(self, now: float, target: Target) -> float:
        """Return by how much the height of the target, or of the whole map, differs from the one
        that drift explains, m."""
        drift = DRIFT_M_S * max(now - self._last_step, 0.0)
        self._last_step = now
        away = target.offset - self._offset
        if not math.isfinite(away):
            self._offset, away = target.offset, 0.0
        self._offset += min(max(away, -drift), drift)
        if self._place is None or np.hypot(*(target.place - self._place)[:2]) > OFFSET_M:
            self._place = target.place.copy()
        below = float(target.place[2] - self._place[2])
        self._place[2] += min(max(below, -drift), drift)
        return max(abs(away), abs(below))
