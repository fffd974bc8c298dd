# SPDX-License-Identifier: Apache-2.0
"""ZEM/ZEV guidance: the thrust now, the time to go, what that costs and what can be reached.

To be at r_f with v_f after the time T, the acceleration (without gravity) that is least in the
square mean is linear in time (D'Souza 1997; Ebrahimi, Bahrami and Roshanian 2008):

    a(0) = 6 ZEM / T² − 2 ZEV / T,    a(T) = −6 ZEM / T² + 4 ZEV / T,

with the miss and the wrong speed that gravity alone would lead to, ZEM = r_f − (r + v T + g T²/2)
and ZEV = v_f − (v + g T). T is free: of those for which the path keeps all limits, the one that
burns least is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import trapezoid

from quadtree_lss.lab.flight.vehicle import Vehicle
from quadtree_lss.onboard.arrays import Array

_AT = np.linspace(0.0, 1.0, 13)
"""Shares of the time to go at which a path is looked at."""


@dataclass(frozen=True)
class Limits:
    """What a path must keep: the share of the range between least and greatest thrust that is
    planned with, at both ends (the rest is for errors); greatest tilt; least elevation seen from
    its end; and how far it stays above that, m; negative allows for errors."""

    thrust_share: float = 0.95
    tilt_deg: float = 40.0
    glide_slope_deg: float = 15.0
    floor: float = -0.5


@dataclass(frozen=True)
class Paths:
    """Paths to K places with M times to go, (K, M). ``propellant``: what each burns, kg.
    ``allowed``: it keeps the limits. ``times``: (M,) s."""

    propellant: Array
    allowed: np.ndarray
    times: Array

    def best(self, k: int = 0) -> tuple[float, float] | None:
        """Time to go and propellant of the cheapest allowed path to place ``k``, None if none."""
        cost = np.where(self.allowed[k], self.propellant[k], np.inf)
        m = int(np.argmin(cost))
        return (float(self.times[m]), float(cost[m])) if np.isfinite(cost[m]) else None


def zem_zev(
    position: Array, velocity: Array, end: Array, end_velocity: Array, t: Any, weight: Array
) -> tuple[Array, Array]:
    """Acceleration (..., 3) by thrust, now, and its change until the end, ``t`` s on, a number or
    an array; all in the map frame, m and s."""
    miss = end - position - velocity * t - 0.5 * weight * t * t
    wrong = end_velocity - velocity - weight * t
    change = 6.0 / t * wrong - 12.0 / (t * t) * miss
    return 6.0 / (t * t) * miss - 2.0 / t * wrong, change


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
    """What it takes to reach each of ``ends`` (K, 3) in each of ``times`` (M,)."""
    t, weight = times[None, :, None], vehicle.weight
    first, change = zem_zev(position, velocity, ends[:, None], end_velocity, t, weight)
    at = _AT[:, None, None, None]
    acceleration = first + change * at  # (n, K, M, 3)
    s = at * t
    place = position + velocity * s + 0.5 * weight * s**2 + 0.5 * first * s**2
    place = place + change * s**2 * at / 6.0
    size = np.linalg.norm(acceleration, axis=-1)
    speed_change = trapezoid(size, _AT, axis=0) * times
    left = mass * np.exp(-speed_change / vehicle.exhaust_speed)
    middle = 0.5 * (mass + left)
    low = vehicle.thrust_min / limits.thrust_share / mass
    high = vehicle.thrust_max * limits.thrust_share / middle
    allowed = (size >= low).all(axis=0) & (size <= high).all(axis=0)
    upright = acceleration[..., 2] >= np.cos(np.radians(limits.tilt_deg)) * size
    # The vehicle takes a while to turn: where it starts is not the path's fault.
    allowed &= upright[1:].all(axis=0)
    away = place - ends[None, :, None]
    across = np.hypot(away[..., 0], away[..., 1])
    slope = np.tan(np.radians(limits.glide_slope_deg))
    began = (position - ends)[None, :, None]
    short = slope * np.hypot(began[..., 0], began[..., 1]) - began[..., 2]
    # A path that begins below the cone must at least not fall farther below it.
    below = slope * across - away[..., 2]
    allowed &= (below <= np.maximum(short * (1.0 - at[..., 0]), 0.0) - limits.floor).all(axis=0)
    return Paths(mass - left, allowed, times)


def thrust_for(vehicle: Vehicle, mass: float, acceleration: Array) -> Array:
    """Thrust (3,), N, for an acceleration: within the limits, the vertical part first."""
    up = max(float(acceleration[2]), 0.1 * vehicle.gravity)
    up = min(up * mass, 0.97 * vehicle.thrust_max)
    side = mass * acceleration[:2]
    size = float(np.hypot(*side))
    most = min(
        np.tan(np.radians(vehicle.tilt_max_deg)) * up,
        np.sqrt(max(vehicle.thrust_max**2 - up**2, 0.0)),
    )
    if size > most:
        side = side * (most / size)
    return np.array([side[0], side[1], up])
