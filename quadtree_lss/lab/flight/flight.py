# SPDX-License-Identifier: Apache-2.0
"""Simulation of a flight: the true vehicle, its sensors and its guidance.

`Flight.step` advances the flight by one tick and returns the messages of its sensors and guidance.
The same flight runs in lock-step and over DDS.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.lab.flight.gimbal import Gimbal
from quadtree_lss.lab.flight.ground import Ground, start
from quadtree_lss.lab.flight.pilot import Pilot
from quadtree_lss.lab.flight.settings import FlightSettings
from quadtree_lss.lab.flight.vehicle import VehicleState
from quadtree_lss.lab.simulation.lidar import FlashLidar
from quadtree_lss.lab.simulation.recording import Messages
from quadtree_lss.lab.simulation.safety import contact_safe
from quadtree_lss.lab.simulation.trajectory import DriftingNavigation
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config, config_from_values

#: Period of a tick and of the poses, s.
TICK = 0.01
#: Periods of guidance, of scans and of the landing requests, ticks.
GUIDANCE_TICKS, SCAN_TICKS, REQUEST_TICKS = 10, 5, 100
#: Delay of a scan after the pose before it, s.
SCAN_DELAY_S = 0.0037
START_NS = 1_700_000_000 * 10**9
FIELD_OF_VIEW_DEG = 1.0
#: Time after which a flight ends, s.
MAX_TIME_S = 150.0
#: Limits of a soft touchdown: horizontal speed, m/s; tilt, deg; vertical speed, m/s.
MAX_SPEED_ACROSS, MAX_TILT_DEG, MAX_SPEED_DOWN = 0.5, 6.0, 2.0
#: Offset of the poses during the fault ``pose_jump``, m.
POSE_JUMP = np.array([2.0, 0.0, 1.0])
UNIT_SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


class FlightMessage(NamedTuple):
    """A message of the simulated vehicle: topic, stamp and content as arrays."""

    topic: str
    stamp_ns: int
    value: Any

    def message(self, make: Messages) -> Any:
        if self.topic == "nav/pose":
            return make.pose(self.stamp_ns, *self.value)
        if self.topic == "lidar/points":
            return make.scan(self.stamp_ns, self.value)
        if self.topic == "landing/target":
            return make.point(self.stamp_ns, self.value)
        if self.topic == "landing/dispersion":
            covariance = np.diag([*self.value, 0.0, 0.0, 0.0, np.inf])  # at any heading
            level = np.array([0.0, 0.0, 0.0, 1.0])
            return make.pose(self.stamp_ns, np.zeros(3), level, covariance)
        return make.polygon(self.stamp_ns, self.value)


class Sample(NamedTuple):
    """The true state of the vehicle and the mode of the pilot at one time; m, kg, N, s."""

    time: float
    x: float
    y: float
    z: float
    mass: float
    thrust: float
    tilt_deg: float
    mode: str


class Flight:
    """One flight. The seed determines the start, the errors of navigation and lidar, and the ground
    unless ``ground`` is given. ``outcome`` is empty during the flight."""

    def __init__(self, seed: int, settings: FlightSettings, ground: Ground | None = None) -> None:
        seeds = np.random.SeedSequence(seed).spawn(4)
        field, navigation, lidar, scatter = (np.random.default_rng(s) for s in seeds)
        self.settings = settings
        self.ground = Ground.of(settings, field) if ground is None else ground
        began = start(settings, self.ground.planned, scatter)
        self.lander = VehicleState(settings.vehicle, *began)
        self._ticks = 0
        self._draw_navigation_errors(navigation)
        planned = self.ground.planned + np.array([0.0, 0.0, scatter.normal(0.0, 1.0)])
        avoid = settings.avoidance in ("package", "paper")
        if settings.avoidance == "perfect" and (best := self.ground.best_point()) is not None:
            planned = best
        config = flight_config(settings, self.ground)
        flown, commit = (settings.vehicle, settings.rules, planned), config.lss.commit_height
        self.pilot = Pilot(*flown, avoid=avoid, commit_height=commit)
        self.scanning = avoid
        self.gimbal = Gimbal(settings.plan, FIELD_OF_VIEW_DEG, planned, self.ground.half)
        wrong = settings.range_noise, settings.outliers, settings.dropouts
        self._lidar = FlashLidar(FIELD_OF_VIEW_DEG, 128, *wrong)
        self._lidar_generator = lidar
        self._pending_faults = list(settings.faults)
        self.active: dict[str, float] = {}  # end of each active fault, s
        self.failed: list[tuple[str, float, float]] = []  # kind, begin and end of all faults, s
        self.areas: list[tuple[float, Array]] = []  # time, s, and published landing area (V, 2)
        self.outcome: Literal["", "touchdown", "aborted", "time"] = ""
        self.samples: list[Sample] = []
        self._last_sent: dict[str, bytes] = {}
        self._last_view = (np.zeros(3), np.eye(3))

    @property
    def time(self) -> float:
        return self._ticks * TICK

    @property
    def stamp_ns(self) -> int:
        return START_NS + self._ticks * round(TICK * 1e9)

    def step(self) -> list[FlightMessage]:
        """Advance by one tick; return the messages sent, in order."""
        jump = POSE_JUMP if "pose_jump" in self.active else 0.0
        position = self.lander.position + (self._position_error[self._ticks] + jump)
        velocity = self.lander.velocity + self._velocity_error[self._ticks]
        if self._ticks % GUIDANCE_TICKS == 0:
            thrust = self.pilot.guide(self.time, position, velocity, self.lander.mass)
            self.lander.command(thrust)
            self._sample()
        self._update_faults(float(position[2] - self.pilot.aim[2]))
        sent = list(self._sensor_messages(position, velocity)) if self.scanning else []
        self.lander.step(TICK)
        self._ticks += 1
        self._update_outcome()
        return sent

    def result(self) -> dict[str, Any]:
        place, velocity = self.lander.position, self.lander.velocity
        down = self.outcome == "touchdown"
        across, sink = float(np.hypot(*velocity[:2])), float(-velocity[2])
        soft = (
            across <= MAX_SPEED_ACROSS
            and sink <= MAX_SPEED_DOWN
            and self.lander.tilt_deg <= MAX_TILT_DEG
        )
        firm = down and contact_safe(self.ground.terrain, place[:2])[0]
        events = [d.what for d in self.pilot.decisions]
        diverts = [d for d in self.pilot.decisions if d.what in ("divert", "target") and d.time > 0]
        return {
            "outcome": self.outcome,
            "safe": bool(firm and soft),
            "ground_safe": bool(firm),
            "soft": bool(down and soft),
            "x": float(place[0]),
            "y": float(place[1]),
            "z": float(place[2]),
            "error": float(np.hypot(*(place - self.pilot.aim)[:2])) if down else None,
            "speed_across": across,
            "speed_down": sink,
            "tilt_deg": self.lander.tilt_deg,
            "time": self.time,
            "propellant": self.lander.burnt,
            "diverts": events.count("divert"),
            "last_divert_time": diverts[-1].time if diverts else None,
            "last_divert_height": diverts[-1].height if diverts else None,
            "hovered": "hover" in events,
            "from_planned": float(np.hypot(*(place - self.ground.planned)[:2])),
        }

    def _draw_navigation_errors(self, generator: np.random.Generator) -> None:
        times = TICK * np.arange(round(MAX_TIME_S / TICK) + 2)
        still = np.zeros((times.size, 3)), np.broadcast_to(np.eye(3), (times.size, 3, 3))
        found = DriftingNavigation().estimate(generator, times, *still)
        self._position_error, self._attitude_error = found.positions, found.rotations
        self._covariance = found.covariance
        slow = DriftingNavigation(position_bias=0.02, position_drift=0.01)
        self._velocity_error = slow.estimate(generator, times, *still).positions

    def _sample(self) -> None:
        lander = self.lander
        state = lander.mass, lander.thrust, lander.tilt_deg
        self.samples.append(Sample(self.time, *lander.position.tolist(), *state, self.pilot.mode))

    def _update_faults(self, height: float) -> None:
        self.active = {kind: until for kind, until in self.active.items() if self.time < until}
        for fault in [fault for fault in self._pending_faults if height <= fault.height]:
            self.active[fault.kind] = self.time + fault.seconds
            self.failed.append((fault.kind, self.time, self.active[fault.kind]))
            self._pending_faults.remove(fault)
            if fault.kind == "keep_out":  # replaces the previous one
                self._last_sent.pop("landing/keep_out", None)

    def _sensor_messages(self, position: Array, velocity: Array) -> Iterator[FlightMessage]:
        pilot = self.pilot
        before = self._last_view
        self.gimbal.step(self.time, position, velocity, pilot.target, TICK, pilot.aim)
        rotation = self.gimbal.rotation()
        self._last_view = (self.lander.position.copy(), rotation)
        if "pose_gap" not in self.active:
            xyzw = Rotation.from_matrix(rotation).as_quat()
            yield FlightMessage("nav/pose", self.stamp_ns, (position, xyzw, self._covariance))
        looking = not pilot.committed and pilot.mode not in ("terminal", "abort")
        if self._ticks % SCAN_TICKS == 1 and looking and "lidar_gap" not in self.active:
            yield self._scan(before)
        if self._ticks % REQUEST_TICKS == 0:
            area = pilot.area()
            if area is not None:
                self.areas.append((self.time, area))
                yield from self._send_if_new("landing/area", area)
            variances = np.diag(self._covariance)[:2] + self.settings.rules.dispersion**2
            yield from self._send_if_new("landing/dispersion", variances)
            yield from self._send_if_new("landing/target", pilot.aim)
        if "keep_out" in self.active and "landing/keep_out" not in self._last_sent:
            yield from self._send_if_new("landing/keep_out", pilot.aim[:2] + 4.0 * UNIT_SQUARE)

    def _scan(self, before: tuple[Array, Array]) -> FlightMessage:
        """Scan from a view interpolated between the last tick (``before``) and this one."""
        share = SCAN_DELAY_S / TICK
        (place, turn), (place_now, turn_now) = before, self._last_view
        place = place + share * (place_now - place)
        moved = Rotation.from_matrix(turn.T @ turn_now).as_rotvec()
        turn = turn @ Rotation.from_rotvec(share * moved).as_matrix()
        # The gimbal points by the estimated attitude, so its error turns the true boresight.
        turn = self._attitude_error[self._ticks].T @ turn
        points = self._lidar.scan(self.ground.terrain, place, turn, self._lidar_generator)
        stamp = self.stamp_ns - round((TICK - SCAN_DELAY_S) * 1e9)
        return FlightMessage("lidar/points", stamp, points)

    def _send_if_new(self, topic: str, value: Array) -> Iterator[FlightMessage]:
        """Send a value that differs from the last one sent on the topic."""
        content = np.round(value, 3).tobytes()
        if self._last_sent.get(topic) != content:
            self._last_sent[topic] = content
            yield FlightMessage(topic, self.stamp_ns, value)

    def _update_outcome(self) -> None:
        if self.ground.touches(self.lander.position):
            self.outcome = "touchdown"
        elif self.pilot.mode == "abort":
            self.outcome = "aborted"
        elif self.time >= MAX_TIME_S:
            self.outcome = "time"
        if self.outcome:
            self._sample()


def flight_config(settings: FlightSettings, ground: Ground) -> Config:
    """Load ``config/flight.yaml`` with the overrides of the settings and the domain centred on the
    planned landing point."""
    config = load_config(["flight"], dict(settings.config), origin="settings")
    half = 0.5 * config.domain.size
    x, y = (float(middle) - half for middle in ground.planned[:2])
    over: dict[str, Any] = {"lss.assessment": "paper"} if settings.avoidance == "paper" else {}
    return config_from_values(over | {"domain.xmin": x, "domain.ymin": y}, config)
