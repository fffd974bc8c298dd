# SPDX-License-Identifier: Apache-2.0
"""ZEM/ZEV guidance: thrust, time to go, propellant and reachable places.

The acceleration by thrust that reaches r_f with v_f after the time T with the smallest mean square
is linear in time (D'Souza 1997; Ebrahimi, Bahrami and Roshanian 2008):

    a(0) = 6 ZEM / T² − 2 ZEV / T,    a(T) = −6 ZEM / T² + 4 ZEV / T,

with the errors without thrust ZEM = r_f − (r + v T + g T²/2) and ZEV = v_f − (v + g T). Among the
times within all limits, T is the one that needs the least propellant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import trapezoid

from quadtree_lss.lab.flight.vehicle import Vehicle
from quadtree_lss.onboard.arrays import Array

_FRACTIONS = np.linspace(0.0, 1.0, 13)
"""Fractions of the time to go at which a path is checked."""


@dataclass(frozen=True)
class Limits:
    """Limits of a path."""

    thrust_share: float = 0.95  # factor on the largest thrust; the smallest is divided by it
    tilt_deg: float = 40.0
    glide_slope_deg: float = 15.0  # elevation of a cone over the end of the path
    floor: float = -0.5  # least height above that cone, m


@dataclass(frozen=True)
class Paths:
    """Paths to K places with M ``times`` to go, s: propellant (K, M), kg, and whether the path is
    within the limits (K, M)."""

    propellant: Array
    allowed: np.ndarray
    times: Array

    def best(self, k: int = 0) -> tuple[float, float] | None:
        """Time to go and propellant of the cheapest allowed path to place ``k``, or None."""
        cost = np.where(self.allowed[k], self.propellant[k], np.inf)
        m = int(np.argmin(cost))
        return (float(self.times[m]), float(cost[m])) if np.isfinite(cost[m]) else None


def zem_zev(
    position: Array, velocity: Array, end: Array, end_velocity: Array, t: Any, weight: Array
) -> tuple[Array, Array]:
    """Current acceleration by thrust (..., 3) and its change over the time to go ``t``."""
    position_error = end - position - velocity * t - 0.5 * weight * t * t
    velocity_error = end_velocity - velocity - weight * t
    change = 6.0 / t * velocity_error - 12.0 / (t * t) * position_error
    return 6.0 / (t * t) * position_error - 2.0 / t * velocity_error, change


def paths(
    vehicle: Vehicle,
    mass: float,
    position: Array,
    velocity: Array,
    ends: Array,
    end_velocity: Array,
    times: Array,
    limits: Limits,
) -> Paths:
    """Evaluate the paths to each of ``ends`` (K, 3) in each of ``times`` (M,)."""
    t, weight = times[None, :, None], vehicle.weight
    first, change = zem_zev(position, velocity, ends[:, None], end_velocity, t, weight)
    at = _FRACTIONS[:, None, None, None]
    acceleration = first + change * at  # (n, K, M, 3)
    s = at * t
    place = position + velocity * s + 0.5 * weight * s**2 + 0.5 * first * s**2
    place = place + change * s**2 * at / 6.0
    size = np.linalg.norm(acceleration, axis=-1)
    speed_change = trapezoid(size, _FRACTIONS, axis=0) * times
    final_mass = mass * np.exp(-speed_change / vehicle.exhaust_speed)
    mean_mass = 0.5 * (mass + final_mass)
    min_acceleration = vehicle.thrust_min / limits.thrust_share / mass
    max_acceleration = vehicle.thrust_max * limits.thrust_share / mean_mass
    allowed = (size >= min_acceleration).all(axis=0) & (size <= max_acceleration).all(axis=0)
    upright = acceleration[..., 2] >= np.cos(np.radians(limits.tilt_deg)) * size
    # Ignore the tilt at the start because the vehicle turns slowly.
    allowed &= upright[1:].all(axis=0)
    away = place - ends[None, :, None]
    across = np.hypot(away[..., 0], away[..., 1])
    slope = np.tan(np.radians(limits.glide_slope_deg))
    start = (position - ends)[None, :, None]
    short = slope * np.hypot(start[..., 0], start[..., 1]) - start[..., 2]
    # A path that begins below the cone must not fall farther below it.
    below = slope * across - away[..., 2]
    allowed &= (below <= np.maximum(short * (1.0 - at[..., 0]), 0.0) - limits.floor).all(axis=0)
    return Paths(mass - final_mass, allowed, times)


def limited_thrust(vehicle: Vehicle, mass: float, acceleration: Array) -> Array:
    """Thrust (3,), N, for an acceleration, limited with priority for its vertical part."""
    up = max(float(acceleration[2]), 0.1 * vehicle.gravity)
    up = min(up * mass, 0.97 * vehicle.thrust_max)
    side = mass * acceleration[:2]
    size = float(np.hypot(*side))
    by_tilt = np.tan(np.radians(vehicle.tilt_max_deg)) * up
    side_limit = min(by_tilt, np.sqrt(max(vehicle.thrust_max**2 - up**2, 0.0)))
    if size > side_limit:
        side = side * (side_limit / size)
    return np.array([side[0], side[1], up])
