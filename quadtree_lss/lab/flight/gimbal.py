# SPDX-License-Identifier: Apache-2.0
"""Pointing of the lidar: repeated surveys in strips, first of the candidate area, then around the
target."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass
from math import radians, sqrt

import numpy as np

from quadtree_lss.lab.flight.vehicle import rotate_toward
from quadtree_lss.lab.simulation.trajectory import look_at
from quadtree_lss.onboard.arrays import Array


@dataclass(frozen=True)
class ScanPlan:
    """Parameters of the surveys; s, m."""

    survey: float = 8.0  # duration of a survey of the area
    target_survey: float = 1.5  # and around the target
    half: tuple[float, float] = (9.0, 3.0)  # largest and smallest half side around the target
    overlap: float = 0.2  # of neighbouring strips, of their width
    rate_deg: float = 60.0  # turn rate of the boresight
    scan_rate: float = 20.0


class Gimbal:
    """Boresight (3,), map frame, for surveys of a square: ``centre`` (3,), ``half`` side, m."""

    def __init__(
        self, plan: ScanPlan, field_of_view_deg: float, centre: Array, half: float
    ) -> None:
        self.plan, self.centre, self.half = plan, np.asarray(centre, dtype=np.float64), half
        self._angle = float(np.radians(field_of_view_deg))
        self.boresight = np.array([0.0, 0.0, -1.0])
        self.passes = 0
        self._corners = np.zeros((0, 3))
        self._arc: list[float] = []
        self._began = self._ends = -np.inf

    def step(
        self,
        now: float,
        position: Array,
        velocity: Array,
        target: Array | None,
        dt: float,
        aim: Array | None = None,
    ) -> None:
        """Turn the boresight for ``dt`` s. A survey is around the ``target`` (3,); without one
        it covers the area or, at low height, surrounds ``aim`` (3,)."""
        if now >= self._ends:
            known = (target, aim) if self.passes else (None, None)
            self._plan_survey(now, position, velocity, *known)
            self.passes += 1
        travelled = (now - self._began) / (self._ends - self._began) * self._arc[-1]
        leg = min(bisect_right(self._arc, travelled), len(self._arc) - 1)
        share = (travelled - self._arc[leg - 1]) / (self._arc[leg] - self._arc[leg - 1])
        before, after = self._corners[leg - 1], self._corners[leg]
        wanted = before + min(share, 1.0) * (after - before) - position
        wanted /= sqrt(float(wanted @ wanted))
        if self.passes == 1 and now == self._began:
            self.boresight = wanted
        self.boresight = rotate_toward(self.boresight, wanted, radians(self.plan.rate_deg) * dt)

    def rotation(self) -> Array:
        """Rotation (3, 3) from lidar axes to the map."""
        return look_at(np.zeros(3), self.boresight)

    def _plan_survey(
        self, now: float, position: Array, velocity: Array, target: Array | None, aim: Array | None
    ) -> None:
        """Plan strips across the line of sight, from near to far, as wide as the footprint f at the
        end of the survey. T s cover a square of half side h if
        (2 h)^2 <= ((1 - overlap) f)^2 T rate, less a tenth for turns. If they do not cover the
        area, survey the surroundings of the aim."""
        centre = self.centre if target is None else target
        seconds = self.plan.survey if target is None else self.plan.target_survey
        half = self.half
        if target is None and aim is not None:
            across = self._angle * float(np.linalg.norm(aim - position - 0.9 * seconds * velocity))
            scans = seconds * self.plan.scan_rate
            covered = 0.45 * (1.0 - self.plan.overlap) * across * sqrt(scans)
            if covered < half:
                centre, half = aim, max(covered, self.plan.half[1])
                seconds *= (half / covered) ** 2
        sight = centre - position
        across_deep = self._angle * float(np.linalg.norm(sight - 0.9 * seconds * velocity))
        if target is not None:
            half = float(np.clip(3.0 * across_deep, self.plan.half[1], self.plan.half[0]))
        level = float(np.hypot(*sight[:2]))
        along = sight[:2] / level if level > 1.0 else np.array([1.0, 0.0])
        # A flat line of sight lengthens the footprint.
        deep = across_deep / max(-sight[2] / float(np.linalg.norm(sight)), 0.2)
        edge = max(half * (abs(along[0]) + abs(along[1])) - 0.4 * deep, 0.0)
        strips = 1 + int(np.ceil(2.0 * edge / (deep * (1.0 - self.plan.overlap))))
        rows = np.linspace(-edge, edge, strips)
        end = max(half - 0.3 * across_deep, 0.0)
        left = np.array([-along[1], along[0]])
        corners = []
        for k, row in enumerate(rows):
            side = end if k % 2 == self.passes % 2 else -end
            ends = (centre[:2] + row * along + s * left for s in (side, -side))
            corners += [[*place, centre[2]] for place in ends]
        self._corners = np.array(corners)
        steps = np.linalg.norm(np.diff(self._corners, axis=0), axis=1)
        self._arc = [0.0, *np.cumsum(np.maximum(steps, 1e-6)).tolist()]
        self._began, self._ends = now, now + seconds
