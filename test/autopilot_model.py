# SPDX-License-Identifier: Apache-2.0
"""Small model of ArduPilot and PX4 with a vehicle, over MAVLink.

Written from their documentation and sources (modes guided and land; precland, offboard). The
vehicle follows its set-points as a point of first order in speed.
"""

import socket
import threading
import time
from contextlib import suppress

import numpy as np

from quadtree_lss.onboard.autopilot.link import (
    ARDUPILOT,
    GUIDED_MODES,
    POSITION_MASK,
    POSITION_SINK_MASK,
    PX4,
    dialect,
)

LOITER, LAND = 5, 9
PX4_HOLD, PX4_LAND = 4 << 16 | 3 << 24, 4 << 16 | 6 << 24
STEP_S = 0.01
OFFBOARD_LOSS_S, OFFBOARD_PROOF_S = 0.5, 1.0
LNDMC_Z_VEL_MAX = 0.25
LAND_SPEED = 1.0


def free_port():
    """Between those of ROS domains, for the system gives away its own until a node has come."""
    ports = 7400 + 250 * np.arange(1, 98)[:, None] + np.arange(80, 240)
    for port in np.random.default_rng().permutation(ports.ravel()).tolist():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise OSError("no free port")


class Autopilot(threading.Thread):
    """Model of either autopilot, armed in the air; a context manager.

    Attributes:
        position, velocity: NED of its origin, m and m/s.
        mode, armed: As its heartbeat says.
        takes_off: By a command of the pilot's, which a set-point would break off.
        frozen: Poses are sent no more; heartbeats are.
        cut: Nothing passes in either direction.
        hears_nothing: Nothing passes to it.
        delay: Of poses, s.
        landed_at: Where it came to the ground, or None.
        points: Set-points that it took: time and NED.
        boot: When its clock began, by this computer's clock, s.
        deaf: Commands that it does not hear before it hears one.
        body_velocity: ODOMETRY has it along the body's axes, else north, east, down as PX4's own.
        heard: Systems that sent something.
        knows_velocity: Else LOCAL_POSITION_NED has none.
        pace: Seconds of its own that pass in one of this computer.
        claims: What it says of the ground instead of the truth: landed_state, or None.
        commands: Modes and disarming that it was asked for.
        lowest: Its least height since somebody set it, m.
    """

    def __init__(self, kind, place_enu, ground=0.0, speed=4.0, pace=1.0):
        super().__init__(daemon=True)
        self.kind, self.ground, self.speed, self.pace = kind, ground, speed, pace
        east, north, up = place_enu
        self.position, self.velocity = np.array([north, east, -up], float), np.zeros(3)
        self.mode = LOITER if kind == ARDUPILOT else PX4_HOLD
        self.armed, self.landed_at = True, None
        self.frozen = self.cut = False
        self.delay, self.yaw, self.shift = 0.0, 0.7, np.zeros(3)
        self.deaf, self.body_velocity, self.heard = 0, False, set()
        self.points, self.texts, self.targets, self.left_offboard = [], [], [], 0
        self.boot = time.time() - 12345.0
        self.goal = self.position.copy()
        self.port = free_port()
        self.takes_off = self.hears_nothing = False
        self.knows_velocity = True
        self.claims, self.commands, self.lowest = None, [], np.inf
        self._rates, self._sink = {}, 0.0
        self._landed = self._down
        self._end = threading.Event()
        self._lock = threading.Lock()

    @property
    def connection(self):
        return f"udpin:127.0.0.1:{self.port}"

    @property
    def enu(self):
        north, east, down = self.position
        return np.array([east, north, -down])

    def switch(self, mode):
        """Change the mode, as the pilot or by a command; return False if it is rejected."""
        with self._lock:
            return self._switch(mode)

    def __enter__(self):
        self.moves_port()
        self.start()
        return self

    def moves_port(self):
        """Send from a new address."""
        with self._lock:
            self._link = dialect().mavlink_connection(
                f"udpout:127.0.0.1:{self.port}", source_system=7, source_component=1
            )

    def __exit__(self, *_):
        self._end.set()
        self.join(5.0)
        self._link.close()

    def run(self):
        begin, steps, pending = time.monotonic(), 0, []
        base = self._clock()
        while not self._end.is_set():
            now = self.pace * (time.monotonic() - begin)
            self._now = now
            with self._lock:
                while (message := self._link.recv_msg()) is not None:
                    if not (self.cut or self.hears_nothing):
                        self._take(message, now)
                while steps * STEP_S < now:
                    self._step(steps * STEP_S)
                    steps += 1
                    if steps % 2 == 0 and not self.frozen:
                        pending.append((now + self.delay, self._poses(base + steps * STEP_S)))
                    if steps % 20 == 0 and 245 in self._rates:
                        # PX4 looks for the ground only while it is to go down.
                        finds = self.kind == ARDUPILOT or self._sink >= 1.1 * LNDMC_Z_VEL_MAX
                        self._landed |= finds or not self.armed
                        self._landed &= self._down
                        state = 3 if self.takes_off else 2 - self._landed
                        state = state if self.claims is None else self.claims
                        pending.append((now, [("extended_sys_state", (0, state))]))
                    if steps % (20 if 0 in self._rates else 50) == 0:
                        bits = 1 | 128 * self.armed
                        beat = (2, self.kind, bits, self.mode, 4)
                        pending.append((now, [("heartbeat", beat)]))
            while pending and pending[0][0] <= now:
                for name, values in pending.pop(0)[1]:
                    self._say(name, *values)
            time.sleep(0.002)

    @property
    def _down(self):
        return -self.position[2] <= self.ground + 1e-3

    def _say(self, name, *values):
        if not self.cut:
            try:
                getattr(self._link.mav, f"{name}_send")(*values)
            except OSError:
                pass

    def _clock(self):
        return self.pace * (time.time() - self.boot)

    def _north_of_body(self):
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def _poses(self, at):
        half = 0.5 * self.yaw
        q = (np.cos(half), 0.0, 0.0, np.sin(half))
        place = self.position + self.shift
        if self.kind == PX4:
            along, child = self.velocity, 1
            if self.body_velocity:
                along, child = self._north_of_body().T @ self.velocity, 12
            upper = np.zeros(21)
            upper[[0, 6, 11, 15, 18, 20]] = 0.01, 0.02, 0.03, 1e-4, 2e-4, 3e-4
            values = (round(1e6 * at), 1, child, *place, q, *along, 0.0, 0.0, 0.0, upper, upper)
            return [("odometry", values)] if 331 in self._rates else []
        said = []
        if 32 in self._rates:
            velocity = self.velocity if self.knows_velocity else np.full(3, np.nan)
            said.append(("local_position_ned", (round(1e3 * at), *place, *velocity)))
        if 31 in self._rates:
            said.append(("attitude_quaternion", (round(1e3 * at), *q, 0.0, 0.0, 0.0)))
        return said

    def _take(self, message, now):
        kind = message.get_type()
        self.heard.add(message.get_srcSystem())
        lost = kind == "COMMAND_LONG" and (message.command in (176, 400) or message.param1 == 245)
        if lost and self.deaf:
            self.deaf -= 1
        elif kind == "TIMESYNC" and message.tc1 == 0:
            self._say("timesync", round(1e9 * self._clock()), message.ts1)
        elif kind == "STATUSTEXT":
            if message.chunk_seq:  # a piece more of the last one, as ground stations take it
                assert message.id == self._text_id and len(self.texts[-1]) % 50 == 0
                self.texts[-1] += message.text
            else:
                self.texts.append(message.text)
            self._text_id = message.id
        elif kind == "COMMAND_LONG" and message.command == 511:
            self._rates[int(message.param1)] = message.param2
        elif kind == "COMMAND_LONG" and message.command == 176:
            self.commands.append(message.param2)
            px4 = int(message.param2) << 16 | int(message.param3) << 24
            self._switch(px4 if self.kind == PX4 else int(message.param2))
        elif kind == "COMMAND_LONG" and message.command == 400:
            self.commands.append("disarm")
            self.armed &= not self._down
        elif kind == "SET_POSITION_TARGET_LOCAL_NED":
            self._on_point(message, now)
        elif kind == "LANDING_TARGET" and message.position_valid:
            self._on_target(message, now)

    def _on_point(self, message, now):
        place = np.array([message.x, message.y, message.z])
        sinks = self.kind == PX4 and message.type_mask == POSITION_SINK_MASK and message.vz > 0.0
        good = message.coordinate_frame == 1 and (sinks or message.type_mask == POSITION_MASK)
        assert good and np.isfinite(place).all(), "neither of the two takes this"
        self.points.append((now, place))
        self._sink = message.vz if sinks else 0.0
        if self.mode == GUIDED_MODES[self.kind]:
            self.goal = place - self.shift
            # PX4 takes off for what is not below it; its noise sees to the rest.
            self._landed &= self.kind == ARDUPILOT or self.goal[2] > self.position[2]

    def _on_target(self, message, now):
        """Check the frame and the distance that precision landing expects."""
        vector = np.array([message.x, message.y, message.z])
        if self.kind == ARDUPILOT:
            vector = self.position + self._north_of_body() @ vector
        if message.frame == (12, 1)[self.kind == PX4] and (self.kind == PX4 or message.distance):
            self.targets.append((now, vector))

    def _switch(self, mode):
        if mode == GUIDED_MODES[PX4] and self.kind == PX4:
            times = np.array([at for at, _ in self.points if at > self._now - OFFBOARD_PROOF_S])
            steady = len(times) > 2 and np.diff(times).max() < OFFBOARD_LOSS_S
            if not steady or self._now - times[-1] > OFFBOARD_LOSS_S:
                return False
        self.mode, self.goal = mode, self.position.copy()
        return True

    def _step(self, now):
        if not self.armed:
            self.velocity[:] = 0.0
            return
        offboard = self.kind == PX4 and self.mode == GUIDED_MODES[PX4]
        if offboard and now - self.points[-1][0] > OFFBOARD_LOSS_S:
            self.left_offboard += 1
            self._switch(PX4_LAND)
        if self.mode in (LAND, PX4_LAND):
            self.goal[2] = self.position[2] + LAND_SPEED
        wanted = np.clip(1.5 * (self.goal - self.position), -self.speed, self.speed)
        self.velocity += (wanted - self.velocity) * STEP_S / 0.15
        self.position += self.velocity * STEP_S
        self.lowest = min(self.lowest, -self.position[2])
        if -self.position[2] <= self.ground:
            self.position[2] = -self.ground
            self.velocity[:] = 0.0
            if self.landed_at is None:
                self.landed_at = self.enu
            if self.mode in (LAND, PX4_LAND):
                self.armed = False
        elif -self.position[2] > self.ground + 0.2:
            self.landed_at = None
