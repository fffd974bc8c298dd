# SPDX-License-Identifier: Apache-2.0
"""The landing as a machine of states: what is known at a moment in, where to fly to out.

``docs/autopilot.md`` has the table of states and its picture. Nothing in here waits, sends or looks
at a clock: whoever calls `Landing.step` some ten times a second does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.autopilot.seen import (
    OFFSET_M,
    POSE_S,
    GroundContact,
    MapHeight,
    Seen,
    Target,
)
from quadtree_lss.onboard.config.sections import AutopilotConfig

PILOT, WAIT, CLIMB, TRANSIT, DESCEND = "pilot", "wait", "climb", "transit", "descend"
COMMIT, TOUCHDOWN, HOLD = "commit", "touchdown", "hold"
WAVE_OFF, GIVE_UP = "wave_off", "give_up"
STATES = (PILOT, WAIT, CLIMB, TRANSIT, DESCEND, COMMIT, TOUCHDOWN, HOLD, WAVE_OFF, GIVE_UP)
LOW = (DESCEND, COMMIT)
"""Below the gate: what is lost here, is answered by a climb."""

LEAD_S, LEAD_M = 2.0, 0.5
"""A set-point goes ahead of the vehicle by what it flies in so long, and this: an autopilot that
hears no more stays at the last one."""
THROUGH_M = 1.0
"""Below the ground the last set-points lead, so that the vehicle presses on it."""
AT_M, SLOW_M_S = 1.0, 1.0
"""Of the gate's height and of standing still."""
COMMIT_SHARE = 0.25
"""Of the gate's height: below it the vehicle comes down for good, 2 m over the ground from 8 m."""
HEARTBEAT_S = 2.5
"""Without a younger heartbeat nothing is commanded: both autopilots send one a second."""
TARGET_S = 1.0
"""A target that was not repeated for longer counts as withdrawn: lss_node says it again every
0.4 s (``nodes.target_output``), so two may be lost."""
MAP_S = 3.0
"""A target on an older map counts as withdrawn, until the vehicle commits: in three seconds the
vehicle comes down by as many metres, to ground that nobody has looked at since."""
JUMP_M = 0.5
"""A greater jump of the position, against its own velocity, ends the landing: the map lies
elsewhere, by more than a target may be missed by."""
STEADY_S = 2.0
"""A place that jumped more recently is not held: it may be wrong."""
WAVE_OFFS = 3
"""After more the pilot has to take over: what goes wrong four times, will not go right."""
PATIENCE_S = 60.0
"""So long it waits for a target before the pilot has to take over: a killed lss_node that is
back has one again after 20 s (``docs/autopilot.md``)."""


@dataclass(frozen=True)
class Order:
    """What to do, one of `STATES`, and why. ``point``: (3,) set-point in the map, m; None: nothing
    is to be commanded. ``target``: the one that landing goes by; None while landing anywhere is out
    of the question. ``sink``: how fast it comes down to the ground and presses on it, else 0, m/s.
    ``settles``: it stands where it was to land, so that its motors may stop.
    """

    state: str
    text: str
    point: Array | None
    target: Target | None
    sink: float = 0.0
    settles: bool = False


class Landing:
    """Flies to the gate over the target, down to it, and up again when it may not go on. ``state``
    is the present one; ``wave_offs`` counts since the pilot handed over."""

    def __init__(self, config: AutopilotConfig) -> None:
        self._config = config
        self._contact = GroundContact()
        self._jumped_at = -np.inf
        self._begin(PILOT, "not in the mode that follows set-points", 0.0)
        self._reset()

    def _reset(self) -> None:
        self.wave_offs = 0
        self._point: Array | None = None
        self._place: Array | None = None  # of the target that is descended to
        self._home = np.zeros(3)  # where the pilot handed over
        self._gate_height = self._config.gate_height
        self._gate_z = -np.inf
        self._map_height = MapHeight()
        self._then = 0.0
        self._left = False
        self._shifted = ""

    def configure(self, config: AutopilotConfig) -> None:
        """Other limits from the next step on; another gate once the vehicle is not below it."""
        self._config = config

    def _begin(self, state: str, text: str, now: float) -> None:
        self.state, self._text, self._since = state, text, now

    def step(self, seen: Seen) -> Order:
        """The order of this moment."""
        ground_z = None if self._place is None else float(self._place[2])
        self._contact.update(seen, ground_z, self._point)
        if self._contact.made and self.state not in (PILOT, TOUCHDOWN):
            self._touch(seen)
        if seen.jump > JUMP_M:
            self._jumped_at = seen.now
        if seen.jump > JUMP_M and self.state != PILOT:
            self._shift(seen, f"navigation jumped by {seen.jump:.1f} m: the map lies elsewhere now")
        if seen.heartbeat_age > HEARTBEAT_S:
            if self.state != PILOT:
                self._halt(seen, f"no heartbeat for {seen.heartbeat_age:.1f} s")
            return Order(self.state, self._text, None, None)  # whoever flies now, is not known
        if not seen.ours or not seen.armed:
            self._leave(seen)
            return Order(self.state, self._text, None, None)
        if self.state == TOUCHDOWN and not self._left:
            if self._contact.made:
                return self._press(seen)
            self._lift(seen)
        if self.state in (PILOT, TOUCHDOWN):
            steady = seen.now - self._jumped_at >= STEADY_S
            if seen.landed is not False or seen.pose_age > POSE_S or not steady:
                return self._wait_for_air(seen)
            self._reset()
            self._home = seen.position.copy()
            self._begin(WAIT, "the autopilot follows set-points", seen.now)
        if self.state not in LOW:
            self._gate_height = self._config.gate_height
        dt = min(max(seen.now - self._then, 0.0), 0.5) if self._point is not None else 0.0
        self._then = seen.now
        target, why = self._usable(seen)
        self._decide(seen, target, why)
        point = seen.position.copy() if self._point is None else self._point
        sink = self._move(point, seen, target, dt) if seen.pose_age <= POSE_S else 0.0
        self._point = point
        target = None if self.state == GIVE_UP or seen.pose_age > POSE_S else target
        return Order(self.state, self._text, point.copy(), target, sink)

    def stay(self, seen: Seen) -> Array | None:
        """A set-point (3,) that changes nothing, for an autopilot that wants some before it follows
        them; None while it is not known whether the vehicle stands on the ground, where PX4 takes
        off for any point that does not lie below it."""
        contact = self._contact
        if contact.rests and contact.place is not None:
            return contact.place - (0.0, 0.0, THROUGH_M)
        return seen.position if seen.landed is False or contact.refuted else None

    def _over(self, seen: Seen) -> float:
        """The height over the ground that the vehicle descended to, infinite if it did not, m."""
        return np.inf if self._place is None else float(seen.position[2] - self._place[2])

    def _touch(self, seen: Seen) -> None:
        over, text = self._over(seen), "on the ground"
        if over > AT_M:
            text += " elsewhere than planned: pilot, take over"
        self._begin(TOUCHDOWN, text, seen.now)

    def _press(self, seen: Seen) -> Order:
        """On the ground: presses on it, where a newer pose may show it, until the motors stop."""
        self._point = seen.position - (0.0, 0.0, THROUGH_M)
        settles = self._contact.rests and self._over(seen) <= AT_M
        sink = self._config.touchdown_speed
        return Order(TOUCHDOWN, self._text, self._point, None, sink, settles)

    def _lift(self, seen: Seen) -> None:
        """In the air again: goes on down to the target if that is still below, else up."""
        self._begin(COMMIT, "in the air again", seen.now)
        if self._shifted:
            self._shift(seen, self._shifted)
        elif self._over(seen) > AT_M:
            self._wave_off(seen, self._text)

    def _wait_for_air(self, seen: Seen) -> Order:
        """Nothing is commanded: to stay where it was once seen is to fly."""
        text = f"the pose is {seen.pose_age:.1f} s old"
        if seen.pose_age <= POSE_S:
            text = f"navigation jumped less than {STEADY_S:g} s ago"
        if seen.landed is not False:
            text = "on the ground" if seen.landed else "on the ground or not: nothing says so"
        self._begin(PILOT, text, seen.now)
        return Order(PILOT, self._text, None, None)

    def _shift(self, seen: Seen, why: str) -> None:
        """Where the map lies by navigation is not known any more."""
        if self.state == TOUCHDOWN:
            self._shifted = why
            return
        self._place = None
        self._give_up(seen, why)

    def _leave(self, seen: Seen) -> None:
        """Somebody else flies, or nobody does any more."""
        self._left = True
        if self.state == COMMIT and (seen.landed or not seen.armed):
            self._begin(TOUCHDOWN, "on the ground", seen.now)
        elif self.state not in (PILOT, TOUCHDOWN) or (seen.armed and not seen.landed):
            self._begin(PILOT, "the autopilot is in another mode: the pilot flies", seen.now)

    def _usable(self, seen: Seen) -> tuple[Target | None, str]:
        """The target if it may be landed at, else why not."""
        target, config = seen.target, self._config
        if target is None:
            return None, seen.why
        if target.age > TARGET_S:
            return None, f"the target was last said {target.age:.1f} s ago: lss_node is silent"
        if not abs(target.map_age) <= MAP_S and self.state != COMMIT:
            if not target.map_age > 0.0:
                return None, "how old the map is cannot be known: its stamps are of another clock"
            return None, f"the map is {target.map_age:.1f} s old"
        away = float(np.hypot(*(target.place - self._home)[:2]))
        if away > config.reach:
            return None, f"the target is {away:.0f} m from where the pilot handed over"
        if target.place[2] > seen.position[2] + AT_M:
            over = target.place[2] - seen.position[2]
            return None, f"the target lies {over:.1f} m above the vehicle: quadtree-lss doctor"
        return target, ""

    def _decide(self, seen: Seen, target: Target | None, why: str) -> None:
        """The next state."""
        now = seen.now
        if self.state == GIVE_UP:
            return
        if seen.pose_age > POSE_S:
            self._halt(seen, f"the pose is {seen.pose_age:.1f} s old")
            return
        if self.state == HOLD and seen.position[2] < self._gate_z - AT_M:
            self._wave_off(seen, self._text)  # it stood still below the gate, and may go on again
        if target is None and self.state in LOW:
            self._wave_off(seen, why)
        elif target is None and self.state in (CLIMB, TRANSIT):
            self._begin(HOLD, why, now)
            self._point = None
        if target is not None:
            shift = self._map_height.shift(now, target)
            if shift > OFFSET_M:
                self._shift(seen, f"the map's height changed by {shift:.1f} m at once")
            else:
                self._fly_on(seen, target)
        elif self.state in (WAIT, HOLD):
            self._text = why
            if now - self._since > PATIENCE_S:
                self._give_up(seen, f"no target for {PATIENCE_S:g} s: {why}")
        if self.state == WAVE_OFF and seen.position[2] > self._gate_z - AT_M:
            self._begin(HOLD, self._text, now)

    def _fly_on(self, seen: Seen, target: Target) -> None:
        """The next state while there is a target."""
        now, place = seen.now, target.place
        gate_z = place[2] + self._gate_height
        off = float(np.hypot(*(place - seen.position)[:2]))
        if self.state in LOW and self._place is not None:
            if np.hypot(*(place - self._place)[:2]) > OFFSET_M:
                self._wave_off(seen, "the target is another one")
            elif self.state == COMMIT and off > 2.0 * OFFSET_M:
                self._wave_off(seen, f"{off:.1f} m beside the target")
        if self.state in (WAIT, HOLD):
            low = seen.position[2] < gate_z - AT_M
            self._begin(CLIMB if low else TRANSIT, "to the gate over the target", now)
        if self.state not in (*LOW, WAVE_OFF, GIVE_UP):
            self._gate_z = gate_z
        if self.state == CLIMB and seen.position[2] > gate_z - AT_M:
            self._begin(TRANSIT, self._text, now)
        still = float(np.linalg.norm(seen.velocity)) < SLOW_M_S
        above = abs(seen.position[2] - gate_z) < AT_M
        if self.state == TRANSIT and off < OFFSET_M and still and above:
            self._place = place.copy()
            self._begin(DESCEND, "over the target", now)
        low = seen.position[2] - place[2] < COMMIT_SHARE * self._gate_height + LEAD_M
        if self.state == DESCEND and low and off < 0.5 * OFFSET_M:
            self._begin(COMMIT, "close over the target", now)

    def _wave_off(self, seen: Seen, why: str) -> None:
        self.wave_offs += 1
        self._point = None
        if self.wave_offs > WAVE_OFFS:
            self._give_up(seen, f"waved off {self.wave_offs} times, now: {why}")
        else:
            self._begin(WAVE_OFF, why, seen.now)

    def _halt(self, seen: Seen, why: str) -> None:
        """Stays where the vehicle was last seen: that needs no present pose."""
        if self.state not in (HOLD, GIVE_UP, TOUCHDOWN):
            self._begin(HOLD, why, seen.now)
            self._point = seen.position.copy()
        if self.state == HOLD and seen.now - self._since > PATIENCE_S:
            self._give_up(seen, f"{why}, for {PATIENCE_S:g} s")

    def _give_up(self, seen: Seen, why: str) -> None:
        """Up to the gate, by no more than its height, and stay until the pilot takes over."""
        self._gate_z = min(self._gate_z, seen.position[2] + self._gate_height)
        if self.state != GIVE_UP:
            self._begin(GIVE_UP, f"pilot, take over: {why}", seen.now)
            self._point = None if seen.pose_age <= POSE_S else self._point

    def _move(self, point: Array, seen: Seen, target: Target | None, dt: float) -> float:
        """The set-point moves to the state's goal, at its speed and not too far ahead; `Order`'s
        ``sink``."""
        config, position, sink = self._config, seen.position, 0.0
        goal, across, down = point.copy(), config.transit_speed, config.transit_speed
        if self.state in (WAVE_OFF, CLIMB, GIVE_UP):
            goal[2] = max(point[2], self._gate_z)
        elif self.state == TRANSIT and target is not None:
            goal = target.place + (0.0, 0.0, self._gate_height)
        elif self.state in LOW and target is not None:
            down = config.descent_speed
            floor = target.place[2] + COMMIT_SHARE * self._gate_height
            if self.state == COMMIT:
                down, floor = config.touchdown_speed, target.place[2] - THROUGH_M
            beside = np.hypot(*(target.place - position)[:2]) > OFFSET_M
            sink = down if self.state == COMMIT and not beside else 0.0
            goal = np.append(target.place[:2], position[2] if beside else floor)
        way = goal - point
        for part, speed in ((slice(0, 2), across), (slice(2, 3), down)):
            length = float(np.linalg.norm(way[part]))
            if length > 0.0:
                point[part] += way[part] * min(1.0, speed * dt / length)
            ahead = point[part] - position[part]
            most = LEAD_S * speed + LEAD_M
            length = float(np.linalg.norm(ahead))
            if length > most and self.state not in (WAIT, HOLD):
                point[part] = position[part] + ahead * (most / length)
        return sink
