# SPDX-License-Identifier: Apache-2.0
"""Guidance by ``landing/selected`` and the estimated state of the vehicle. Modes:

approach   fly to the gate above the aim (the target, or the planned point before the first target)
hover      wait above the aim for a target
terminal   descend vertically from the gate
abort      climb away because no target came in time
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from quadtree_lss.lab.flight.guidance import Limits, Paths, limited_thrust, paths, zem_zev
from quadtree_lss.lab.flight.vehicle import Vehicle
from quadtree_lss.onboard.arrays import Array


@dataclass(frozen=True)
class Rules:
    """Parameters of guidance; m, m/s, s."""

    limits: Limits = field(default_factory=Limits)
    limit_factor: float = 0.9  # on the limits of tilt and thrust, tried first for a path
    gate: float = 8.0  # height over the aim at the start of the vertical descent
    gate_speed: float = 1.5
    touchdown_speed: float = 1.2
    hover: float = 60.0  # height over the aim while waiting for a target
    max_wait: float = 60.0
    # 1 sigma of the touchdown along x and y, added to the position error. It exceeds the usual
    # 0.1 m because targets at the edge of safe ground are often withdrawn.
    dispersion: float = 0.5
    zone_radius: float = 2.4  # of the landing zone, which ``landing/area`` contains
    headings: int = 12  # number of vertices of that area
    reach: float = 45.0  # their largest distance
    reserve: float = 15.0  # propellant that a divert must leave, kg


class Decision(NamedTuple):
    """A decision of the pilot: time, height over the aim, event and position."""

    time: float
    height: float
    what: str
    x: float
    y: float


class Pilot:
    """Guidance to ``planned`` (3,) or, if ``avoid``, to the targets. Below ``commit_height``, m
    over the aim, the aim no longer changes. ``aim`` (3,) is the intended landing point."""

    def __init__(
        self, vehicle: Vehicle, rules: Rules, planned: Array, *, avoid: bool, commit_height: float
    ) -> None:
        self.vehicle, self.rules, self.avoid = vehicle, rules, avoid
        self.aim = np.array(planned, dtype=np.float64)
        self.commit_height = commit_height
        self.target: Array | None = None
        self.mode = "approach"
        self.decisions: list[Decision] = []
        self.time_to_go = np.nan
        self._plan_time = -np.inf
        self._hover_since = np.inf
        self._now, self._height = 0.0, np.inf
        self._state = (np.zeros(3), np.zeros(3), vehicle.mass)

    @property
    def committed(self) -> bool:
        return self._height < self.commit_height

    def on_selected(self, place: Array | None) -> None:
        """Handle a message on ``landing/selected``: a position (3,), or None without a target."""
        if not self.avoid or self.mode in ("terminal", "abort"):
            return
        first = self.target is None
        if place is None:
            self.target = None
            if not first:
                self._record("lost")
        elif np.hypot(*(place - self.aim)[:2]) < 0.3:
            self.aim[2] = place[2]
            self.target = place
            if first:
                self._restart_approach("target")
        elif self.committed:
            self._record("too late", place)
        elif not self._is_reachable(place):
            self._record("out of reach", place)
        else:
            self.aim, self.target = place.copy(), place
            self._restart_approach("target" if first else "divert")

    def guide(self, now: float, position: Array, velocity: Array, mass: float) -> Array:
        """Return the thrust (3,), N, for the estimated position and velocity (3,)."""
        self._now, self._state = now, (position, velocity, mass)
        self._height = float(position[2] - self.aim[2])
        if self.mode == "approach":
            self._check_hover(now)
        if self.mode == "approach":
            return self._fly_to_gate(now)
        if self.mode == "hover" and now - self._hover_since > self.rules.max_wait:
            self.mode = "abort"
            self._record("abort")
        return self._descend() if self.mode == "terminal" else self._hover()

    def area(self) -> Array | None:
        """Polygon (V, 2) around the reachable landing zones; None after commitment, or if the gate
        is out of reach."""
        rules = self.rules
        if self.mode in ("terminal", "abort") or self.committed:
            return None
        angles = 2.0 * np.pi * np.arange(rules.headings) / rules.headings
        radii = np.linspace(0.0, rules.reach, 10)
        way = np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
        ends = self.gate() + radii[None, :, None] * way[:, None]
        found = self._paths(ends.reshape(-1, 3), self._times(14))
        short = found.propellant <= self._spare_propellant()
        can = (found.allowed & short).any(axis=1).reshape(rules.headings, -1)
        if not can[:, 0].any():
            return None
        # A heading ends at its first unreachable radius.
        steps = np.cumprod(can, axis=1).sum(axis=1) - 1
        far = radii[steps] + rules.zone_radius
        return self.aim[:2] + far[:, None] * way[:, :2]

    def gate(self, place: Array | None = None) -> Array:
        """Start (3,) of the vertical descent to a place, by default the aim."""
        over = self.aim if place is None else place
        return over + np.array([0.0, 0.0, self.rules.gate])

    def _restart_approach(self, what: str) -> None:
        self.mode, self._plan_time, self.time_to_go = "approach", -np.inf, np.nan
        self._record(what)

    def _record(self, what: str, place: Array | None = None) -> None:
        x, y = (self.aim if place is None else place)[:2]
        last = self.decisions[-1] if self.decisions else None
        if last is None or (last.what, last.x, last.y) != (what, float(x), float(y)):
            self.decisions.append(Decision(self._now, self._height, what, float(x), float(y)))

    def _spare_propellant(self) -> float:
        burnt = self.vehicle.mass - self._state[2]
        return self.vehicle.propellant - burnt - self.rules.reserve

    def _times(self, number: int) -> Array:
        position, velocity, _ = self._state
        distance = float(np.linalg.norm(position - self.gate()))
        typical = distance / max(0.5 * float(np.linalg.norm(velocity)), 3.0)
        return np.geomspace(max(0.5 * typical, 3.0), max(2.5 * typical, 20.0), number)

    def _paths(
        self, ends: Array, times: Array, limits: Limits | None = None, speed: float | None = None
    ) -> Paths:
        """Paths to places (K, 3) with a final downward speed, by default the speed at the gate."""
        position, velocity, mass = self._state
        down = np.array([0.0, 0.0, -(self.rules.gate_speed if speed is None else speed)])
        limits = limits or self.rules.limits
        return paths(self.vehicle, mass, position, velocity, ends, down, times, limits)

    def _is_reachable(self, place: Array) -> bool:
        found = self._paths(self.gate(place)[None], self._times(40)).best()
        return found is not None and found[1] <= self._spare_propellant()

    def _path_to_hover(self, number: int, **limits: float) -> tuple[float, float] | None:
        """Time to go and propellant of the cheapest path to rest at hover height."""
        kept = replace(self.rules.limits, floor=-1e3, glide_slope_deg=0.0, **limits)
        return self._paths(self._hover_point()[None], self._times(number), kept, speed=0.0).best()

    def _hover_point(self) -> Array:
        return self.aim + np.array([0.0, 0.0, self.rules.hover])

    def _check_hover(self, now: float) -> None:
        """Without a target, hover before the vehicle can no longer stop at hover height."""
        if not self.avoid or self.target is not None or now < 1.0:
            return
        low = self._state[0][2] < self._hover_point()[2]
        if low or self._path_to_hover(25, thrust_share=0.85) is None:
            self.mode, self._hover_since = "hover", now
            self._plan_time, self.time_to_go = -np.inf, np.nan
            self._record("hover")

    def _fly_to_gate(self, now: float) -> Array:
        position, velocity, mass = self._state
        down = np.array([0.0, 0.0, -self.rules.gate_speed])
        if now - self._plan_time >= 1.0 - 1e-6 and not self.time_to_go < 4.0:
            self._plan(now)
        self.time_to_go -= 0.1
        if self.time_to_go < 1.0:
            self.mode = "terminal"
            self._record("gate")
            return self._descend()
        weight = self.vehicle.weight
        push, _ = zem_zev(position, velocity, self.gate(), down, self.time_to_go, weight)
        return limited_thrust(self.vehicle, mass, push)

    def _plan(self, now: float) -> None:
        """Find the cheapest time to go; keep the current one if no path is within the limits."""
        self._plan_time = now
        times = self._times(60)
        if np.isfinite(self.time_to_go):
            times = self.time_to_go + np.linspace(-2.0, 4.0, 25)
            times = times[times > 3.0]
        limits, factor, found = self.rules.limits, self.rules.limit_factor, None
        share, tilt = factor * limits.thrust_share, factor * limits.tilt_deg
        reduced = replace(limits, thrust_share=share, tilt_deg=tilt)
        for kept in (reduced, limits):
            if found is None and len(times):
                found = self._paths(self.gate()[None], times, kept).best()
        if found is not None:
            self.time_to_go = found[0] + 0.1
        elif not np.isfinite(self.time_to_go):
            relaxed = replace(limits, thrust_share=1.0, tilt_deg=45.0, floor=-1e3)
            found = self._paths(self.gate()[None], times, relaxed).best()
            self.time_to_go = float(np.median(times)) if found is None else found[0]

    def _descend(self) -> Array:
        """Descend vertically when above the aim, otherwise approach it horizontally."""
        position, velocity, mass = self._state
        off = (self.aim - position)[:2]
        push = np.array([0.0, 0.0, self.vehicle.gravity])
        push[:2] = 0.35 * off - 1.1 * velocity[:2]
        size, most = float(np.hypot(*push[:2])), 0.25 * self.vehicle.gravity
        push[:2] *= min(1.0, most / max(size, 1e-9))
        over = float(np.clip((1.5 - np.hypot(*off)) / 0.7, 0.0, 1.0))
        push[2] += 1.2 * (-over * self.rules.touchdown_speed - velocity[2])
        return limited_thrust(self.vehicle, mass, push)

    def _hover(self) -> Array:
        """Fly to the hover point above the aim and stay there; after an abort climb to it."""
        position, velocity, mass = self._state
        over, gravity = self._hover_point(), self.vehicle.gravity
        if self.mode == "hover" and np.linalg.norm(velocity) > 3.0:
            if not np.isfinite(self.time_to_go):
                self.time_to_go = (self._path_to_hover(60) or (np.nan,))[0]
            if self.time_to_go > 1.5:
                self.time_to_go -= 0.1
                end, weight = (over, np.zeros(3)), self.vehicle.weight
                push, _ = zem_zev(position, velocity, *end, self.time_to_go, weight)
                return limited_thrust(self.vehicle, mass, push)
        push = np.clip(0.25 * (over - position), -2.0, 2.0) - 0.8 * velocity
        push[:2] *= min(1.0, 0.5 * gravity / max(float(np.hypot(*push[:2])), 1e-9))
        push[2] += gravity
        return limited_thrust(self.vehicle, mass, push)
