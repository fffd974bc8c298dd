# SPDX-License-Identifier: Apache-2.0
"""State machine of the landing; ``docs/autopilot.md`` has the table of states.

It does not wait, send or read a clock. The caller runs `Landing.step` ten times a second.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.autopilot.inputs import (
    OFFSET_M,
    POSE_S,
    GroundContact,
    Inputs,
    MapHeight,
    Target,
)
from quadtree_lss.onboard.config.sections import AutopilotConfig

PILOT, WAIT, CLIMB, TRANSIT, DESCEND = "pilot", "wait", "climb", "transit", "descend"
COMMIT, TOUCHDOWN, HOLD = "commit", "touchdown", "hold"
WAVE_OFF, GIVE_UP = "wave_off", "give_up"
STATES = (PILOT, WAIT, CLIMB, TRANSIT, DESCEND, COMMIT, TOUCHDOWN, HOLD, WAVE_OFF, GIVE_UP)
BELOW_GATE = (DESCEND, COMMIT)
"""States in which a lost target leads to a climb."""

LEAD_S, LEAD_M = 2.0, 0.5
"""Largest distance of a set-point from the vehicle: the flight of this time plus this distance. An
autopilot that receives nothing more stops at the last set-point."""
BELOW_GROUND_M = 1.0
"""Depth of the last set-points below the ground, so that the vehicle presses on it."""
HEIGHT_TOLERANCE_M, HOVER_M_S = 1.0, 1.0
"""Tolerance of the gate's height; upper speed limit of a hovering vehicle."""
COMMIT_SHARE = 0.25
"""Fraction of the gate's height below which the vehicle commits: 2 m over the target for 8 m."""
HEARTBEAT_S = 2.5
"""Maximum age of a heartbeat; nothing is commanded without one. Autopilots send one per second."""
TARGET_S = 1.0
"""Time without repetition after which a target counts as withdrawn: lss_node repeats it every 0.4 s
(``nodes.target_output``), so two messages may be lost."""
MAP_S = 3.0
"""Maximum age of the target's map, until the vehicle commits: it descends 3 m in this time."""
JUMP_M = 0.5
"""A larger jump of the position ends the landing, because the map is shifted by more than the
landing error that is tolerated."""
STEADY_S = 2.0
"""Time after a jump in which the position may be wrong; the landing does not start."""
MAX_WAVE_OFFS = 3
"""The pilot has to take over after more wave-offs."""
WAIT_LIMIT_S = 60.0
"""Time without a target after which the pilot has to take over; a restarted lss_node has one again
after 20 s (``docs/autopilot.md``)."""


@dataclass(frozen=True)
class Order:
    """Result of one step."""

    state: str  # one of `STATES`
    text: str  # the reason for it
    point: Array | None  # (3,) set-point in the map, m; None to command nothing
    target: Target | None  # None if no landing is possible
    sink: float = 0.0  # speed of the descent to the ground, and of pressing on it, m/s
    may_stop_motors: bool = False  # the vehicle rests at the target


class Landing:
    """Fly to the gate over the target, descend, and wave off if the descent may not continue.
    ``wave_offs``: number of wave-offs since the pilot handed over."""

    def __init__(self, config: AutopilotConfig) -> None:
        self._config = config
        self._contact = GroundContact()
        self._jumped_at = -np.inf
        self._enter(PILOT, "not in the mode that follows set-points", 0.0)
        self._reset()

    def _reset(self) -> None:
        self.wave_offs = 0
        self._point: Array | None = None
        self._place: Array | None = None  # of the target during the descent
        self._handover_position = np.zeros(3)
        self._gate_height = self._config.gate_height
        self._gate_z = -np.inf
        self._map_height = MapHeight()
        self._last_step = 0.0
        self._control_ended = False
        self._shift_reason = ""

    def configure(self, config: AutopilotConfig) -> None:
        """Set new limits; a new gate height applies once the vehicle is not below the gate."""
        self._config = config

    def _enter(self, state: str, text: str, now: float) -> None:
        self.state, self._text, self._since = state, text, now

    def step(self, inputs: Inputs) -> Order:
        """Process the inputs of one moment."""
        ground_z = None if self._place is None else float(self._place[2])
        self._contact.update(inputs, ground_z, self._point)
        if self._contact.made and self.state not in (PILOT, TOUCHDOWN):
            self._touch_down(inputs)
        if inputs.jump > JUMP_M:
            self._jumped_at = inputs.now
        if inputs.jump > JUMP_M and self.state != PILOT:
            why = f"navigation jumped by {inputs.jump:.1f} m: the map does not fit it any more"
            self._on_map_shift(inputs, why)
        if inputs.heartbeat_age > HEARTBEAT_S:
            if self.state != PILOT:
                self._hold(inputs, f"no heartbeat for {inputs.heartbeat_age:.1f} s")
            return Order(self.state, self._text, None, None)  # the mode is unknown
        if not inputs.accepts_set_points or not inputs.armed:
            self._end_control(inputs)
            return Order(self.state, self._text, None, None)
        if self.state == TOUCHDOWN and not self._control_ended:
            if self._contact.made:
                return self._press_on_ground(inputs)
            self._resume_in_air(inputs)
        if self.state in (PILOT, TOUCHDOWN):
            steady = inputs.now - self._jumped_at >= STEADY_S
            if inputs.landed is not False or inputs.pose_age > POSE_S or not steady:
                return self._wait_for_air(inputs)
            self._reset()
            self._handover_position = inputs.position.copy()
            self._enter(WAIT, "the autopilot follows set-points", inputs.now)
        if self.state not in BELOW_GATE:
            self._gate_height = self._config.gate_height
        dt = min(max(inputs.now - self._last_step, 0.0), 0.5) if self._point is not None else 0.0
        self._last_step = inputs.now
        target, why = self._usable(inputs)
        self._decide(inputs, target, why)
        point = inputs.position.copy() if self._point is None else self._point
        sink = self._move(point, inputs, target, dt) if inputs.pose_age <= POSE_S else 0.0
        self._point = point
        target = None if self.state == GIVE_UP or inputs.pose_age > POSE_S else target
        return Order(self.state, self._text, point.copy(), target, sink)

    def idle_set_point(self, inputs: Inputs) -> Array | None:
        """Return a set-point (3,) that keeps the vehicle in place, because PX4 requires set-points
        before offboard. None while contact with the ground is unknown: on the ground, PX4 takes off
        for a set-point that is not below it."""
        contact = self._contact
        if contact.rests and contact.place is not None:
            return contact.place - (0.0, 0.0, BELOW_GROUND_M)
        return inputs.position if inputs.landed is False or contact.refuted else None

    def _height_over_place(self, inputs: Inputs) -> float:
        """Return the height over the target of the descent, m; infinity before a descent."""
        return np.inf if self._place is None else float(inputs.position[2] - self._place[2])

    def _touch_down(self, inputs: Inputs) -> None:
        text = "on the ground"
        if self._height_over_place(inputs) > HEIGHT_TOLERANCE_M:
            text += ", not at the target: pilot, take over"
        self._enter(TOUCHDOWN, text, inputs.now)

    def _press_on_ground(self, inputs: Inputs) -> Order:
        """Press on the ground until the motors stop."""
        self._point = inputs.position - (0.0, 0.0, BELOW_GROUND_M)
        may_stop_motors = (
            self._contact.rests and self._height_over_place(inputs) <= HEIGHT_TOLERANCE_M
        )
        sink = self._config.touchdown_speed
        return Order(TOUCHDOWN, self._text, self._point, None, sink, may_stop_motors)

    def _resume_in_air(self, inputs: Inputs) -> None:
        """Continue the descent if the vehicle is still low over the target, else wave off."""
        self._enter(COMMIT, "in the air again", inputs.now)
        if self._shift_reason:
            self._on_map_shift(inputs, self._shift_reason)
        elif self._height_over_place(inputs) > HEIGHT_TOLERANCE_M:
            self._wave_off(inputs, self._text)

    def _wait_for_air(self, inputs: Inputs) -> Order:
        """Command nothing until the vehicle flies with a fresh, steady pose."""
        text = f"the pose is {inputs.pose_age:.1f} s old"
        if inputs.pose_age <= POSE_S:
            text = f"navigation jumped less than {STEADY_S:g} s ago"
        if inputs.landed is not False:
            text = "on the ground" if inputs.landed else "ground contact unknown: no recent report"
        self._enter(PILOT, text, inputs.now)
        return Order(PILOT, self._text, None, None)

    def _on_map_shift(self, inputs: Inputs, why: str) -> None:
        """Give up, because the position of the map relative to navigation is unknown."""
        if self.state == TOUCHDOWN:
            self._shift_reason = why
            return
        self._place = None
        self._give_up(inputs, why)

    def _end_control(self, inputs: Inputs) -> None:
        """Enter the state for a mode without set-points, or for disarmed motors."""
        self._control_ended = True
        if self.state == COMMIT and (inputs.landed or not inputs.armed):
            self._enter(TOUCHDOWN, "on the ground", inputs.now)
        elif self.state not in (PILOT, TOUCHDOWN) or (inputs.armed and not inputs.landed):
            self._enter(PILOT, "the autopilot is in another mode: the pilot flies", inputs.now)

    def _usable(self, inputs: Inputs) -> tuple[Target | None, str]:
        """Return the target if a landing is possible, else the reason why not."""
        target, config = inputs.target, self._config
        if target is None:
            return None, inputs.why
        if target.age > TARGET_S:
            return None, f"no target from lss_node for {target.age:.1f} s"
        if not abs(target.map_age) <= MAP_S and self.state != COMMIT:
            if not target.map_age > 0.0:
                return None, "the age of the map is unknown: its stamps are of a different clock"
            return None, f"the map is {target.map_age:.1f} s old"
        distance = float(np.hypot(*(target.place - self._handover_position)[:2]))
        if distance > config.reach:
            return None, f"the target is {distance:.0f} m from where the pilot handed over"
        if target.place[2] > inputs.position[2] + HEIGHT_TOLERANCE_M:
            above = target.place[2] - inputs.position[2]
            return None, f"the target is {above:.1f} m above the vehicle: run quadtree-lss doctor"
        return target, ""

    def _decide(self, inputs: Inputs, target: Target | None, why: str) -> None:
        """Enter the next state."""
        now = inputs.now
        if self.state == GIVE_UP:
            return
        if inputs.pose_age > POSE_S:
            self._hold(inputs, f"the pose is {inputs.pose_age:.1f} s old")
            return
        if self.state == HOLD and inputs.position[2] < self._gate_z - HEIGHT_TOLERANCE_M:
            self._wave_off(inputs, self._text)  # a hold below the gate that may end
        if target is None and self.state in BELOW_GATE:
            self._wave_off(inputs, why)
        elif target is None and self.state in (CLIMB, TRANSIT):
            self._enter(HOLD, why, now)
            self._point = None
        if target is not None:
            shift = self._map_height.shift(now, target)
            if shift > OFFSET_M:
                self._on_map_shift(inputs, f"the map's height changed by {shift:.1f} m at once")
            else:
                self._advance(inputs, target)
        elif self.state in (WAIT, HOLD):
            self._text = why
            if now - self._since > WAIT_LIMIT_S:
                self._give_up(inputs, f"no target for {WAIT_LIMIT_S:g} s: {why}")
        if self.state == WAVE_OFF and inputs.position[2] > self._gate_z - HEIGHT_TOLERANCE_M:
            self._enter(HOLD, self._text, now)

    def _advance(self, inputs: Inputs, target: Target) -> None:
        """Enter the next state of a landing with a target."""
        now, place = inputs.now, target.place
        gate_z = place[2] + self._gate_height
        distance = float(np.hypot(*(place - inputs.position)[:2]))
        if self.state in BELOW_GATE and self._place is not None:
            if np.hypot(*(place - self._place)[:2]) > OFFSET_M:
                self._wave_off(inputs, "the target has moved")
            elif self.state == COMMIT and distance > 2.0 * OFFSET_M:
                self._wave_off(inputs, f"{distance:.1f} m beside the target")
        if self.state in (WAIT, HOLD):
            low = inputs.position[2] < gate_z - HEIGHT_TOLERANCE_M
            self._enter(CLIMB if low else TRANSIT, "to the gate over the target", now)
        if self.state not in (*BELOW_GATE, WAVE_OFF, GIVE_UP):
            self._gate_z = gate_z
        if self.state == CLIMB and inputs.position[2] > gate_z - HEIGHT_TOLERANCE_M:
            self._enter(TRANSIT, self._text, now)
        still = float(np.linalg.norm(inputs.velocity)) < HOVER_M_S
        at_gate = distance < OFFSET_M and abs(inputs.position[2] - gate_z) < HEIGHT_TOLERANCE_M
        if self.state == TRANSIT and at_gate and still:
            self._place = place.copy()
            self._enter(DESCEND, "over the target", now)
        low = inputs.position[2] - place[2] < COMMIT_SHARE * self._gate_height + LEAD_M
        if self.state == DESCEND and low and distance < 0.5 * OFFSET_M:
            self._enter(COMMIT, "close over the target", now)

    def _wave_off(self, inputs: Inputs, why: str) -> None:
        self.wave_offs += 1
        self._point = None
        if self.wave_offs > MAX_WAVE_OFFS:
            self._give_up(inputs, f"{self.wave_offs} wave-offs, the last: {why}")
        else:
            self._enter(WAVE_OFF, why, inputs.now)

    def _hold(self, inputs: Inputs, why: str) -> None:
        """Hold the last known position, which requires no current pose."""
        if self.state not in (HOLD, GIVE_UP, TOUCHDOWN):
            self._enter(HOLD, why, inputs.now)
            self._point = inputs.position.copy()
        if self.state == HOLD and inputs.now - self._since > WAIT_LIMIT_S:
            self._give_up(inputs, f"{why}, for {WAIT_LIMIT_S:g} s")

    def _give_up(self, inputs: Inputs, why: str) -> None:
        """Climb to the gate, at most by its height, and stay until the pilot takes over."""
        self._gate_z = min(self._gate_z, inputs.position[2] + self._gate_height)
        if self.state != GIVE_UP:
            self._enter(GIVE_UP, f"pilot, take over: {why}", inputs.now)
            self._point = None if inputs.pose_age <= POSE_S else self._point

    def _move(self, point: Array, inputs: Inputs, target: Target | None, dt: float) -> float:
        """Move the set-point ``point`` towards the goal of the state; return `Order`'s ``sink``."""
        config, position, sink = self._config, inputs.position, 0.0
        goal, across, down = point.copy(), config.transit_speed, config.transit_speed
        if self.state in (WAVE_OFF, CLIMB, GIVE_UP):
            goal[2] = max(point[2], self._gate_z)
        elif self.state == TRANSIT and target is not None:
            goal = target.place + (0.0, 0.0, self._gate_height)
        elif self.state in BELOW_GATE and target is not None:
            down = config.descent_speed
            floor = target.place[2] + COMMIT_SHARE * self._gate_height
            if self.state == COMMIT:
                down, floor = config.touchdown_speed, target.place[2] - BELOW_GROUND_M
            beside = np.hypot(*(target.place - position)[:2]) > OFFSET_M
            sink = down if self.state == COMMIT and not beside else 0.0
            goal = np.append(target.place[:2], position[2] if beside else floor)
        way = goal - point
        for part, speed in ((slice(0, 2), across), (slice(2, 3), down)):
            length = float(np.linalg.norm(way[part]))
            if length > 0.0:
                point[part] += way[part] * min(1.0, speed * dt / length)
            ahead = point[part] - position[part]
            limit = LEAD_S * speed + LEAD_M
            length = float(np.linalg.norm(ahead))
            if length > limit and self.state not in (WAIT, HOLD):
                point[part] = position[part] + ahead * (limit / length)
        return sink
