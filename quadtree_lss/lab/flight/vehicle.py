# SPDX-License-Identifier: Apache-2.0
"""A lander as a point mass with a thrust vector and actuator limits."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from math import acos, cos, degrees, hypot, radians, sin, sqrt

import numpy as np

from quadtree_lss.onboard.arrays import Array

EARTH_G = 9.80665


@dataclass(frozen=True)
class Vehicle:
    """Parameters of a small lunar lander; kg, N, m/s^2."""

    mass: float = 1800.0  # initial
    propellant: float = 250.0  # part of the mass
    isp: float = 310.0  # specific impulse, s
    thrust_min: float = 1300.0  # the engine stays on in flight
    thrust_max: float = 6600.0
    thrust_rate: float = 6000.0
    tilt_max_deg: float = 45.0  # between thrust and vertical
    tilt_rate_deg: float = 20.0
    delay: float = 0.1  # from a command to its effect, s
    gravity: float = 1.62

    @property
    def exhaust_speed(self) -> float:
        return self.isp * EARTH_G

    @property
    def weight(self) -> Array:
        """Acceleration of gravity (3,), map frame, m/s^2."""
        return np.array([0.0, 0.0, -self.gravity])


class VehicleState:
    """The true state: position (3,), m, and velocity (3,), m/s, map frame; mass, kg; thrust, N, and
    its direction (3,)."""

    def __init__(self, vehicle: Vehicle, position: Array, velocity: Array) -> None:
        self.vehicle = vehicle
        self.position = np.array(position, dtype=np.float64)
        self.velocity = np.array(velocity, dtype=np.float64)
        self.mass = vehicle.mass
        self.thrust = vehicle.mass * vehicle.gravity
        self.direction = np.array([0.0, 0.0, 1.0])
        self._commands: deque[tuple[float, Array]] = deque()
        self._command = self.thrust * self.direction
        self._now = 0.0

    @property
    def burnt(self) -> float:
        return self.vehicle.mass - self.mass

    @property
    def tilt_deg(self) -> float:
        return degrees(acos(min(max(float(self.direction[2]), -1.0), 1.0)))

    def command(self, thrust: Array) -> None:
        """Command a thrust (3,), map frame, N."""
        self._commands.append((self._now + self.vehicle.delay - 1e-9, np.array(thrust)))

    def step(self, dt: float) -> None:
        """Advance the actuators, then the vehicle under constant thrust, by ``dt`` s."""
        while self._commands and self._commands[0][0] <= self._now:
            self._command = self._commands.popleft()[1]
        self._actuate(dt)
        v = self.vehicle
        if self.burnt >= v.propellant:
            self.thrust = 0.0
        acceleration = v.weight + self.thrust / self.mass * self.direction
        self.position += dt * self.velocity + 0.5 * dt * dt * acceleration
        self.velocity += dt * acceleration
        self.mass -= dt * self.thrust / v.exhaust_speed
        self._now += dt

    def _actuate(self, dt: float) -> None:
        v = self.vehicle
        size = sqrt(float(self._command @ self._command))
        wanted = self._command / size if size > 0.0 else np.array([0.0, 0.0, 1.0])
        limit = radians(v.tilt_max_deg)
        if wanted[2] < cos(limit):
            side = sin(limit) / max(hypot(wanted[0], wanted[1]), 1e-12)
            wanted = np.array([side * wanted[0], side * wanted[1], cos(limit)])
        self.direction = rotate_toward(self.direction, wanted, radians(v.tilt_rate_deg) * dt)
        change = min(max(size - self.thrust, -v.thrust_rate * dt), v.thrust_rate * dt)
        self.thrust = min(max(self.thrust + change, v.thrust_min), v.thrust_max)


def rotate_toward(old: Array, new: Array, max_angle: float) -> Array:
    """Rotate the unit vector ``old`` (3,) toward ``new`` by at most ``max_angle`` rad."""
    angle = acos(min(max(float(new @ old), -1.0), 1.0))
    if angle > max_angle:
        new = sin(angle - max_angle) * old + sin(max_angle) * new
    return new / sqrt(float(new @ new))
