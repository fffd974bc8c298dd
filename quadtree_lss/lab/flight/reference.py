# SPDX-License-Identifier: Apache-2.0
"""The least propellant that any guidance could need, by convex programs.

Powered descent with free thrust direction is made convex without loss (Açıkmeşe and Ploen 2007;
Blackmore, Açıkmeşe and Scharf 2010): the thrust's size is bounded by a slack that is bounded from
both sides, and mass enters by its logarithm, about which the bounds are expanded. Needs the extra
``guidance`` (``cvxpy`` with Clarabel).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from quadtree_lss.lab.flight.guidance import Limits
from quadtree_lss.lab.flight.vehicle import Vehicle
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.errors import QuadtreeLssError


@dataclass(frozen=True)
class Optimum:
    """The cheapest descent: propellant, kg; time, s; position and velocity (N + 1, 3), thrust (N +
    1,), N."""

    propellant: float
    time: float
    position: Array
    velocity: Array
    thrust: Array


class Descent:
    """Descents of one vehicle in N steps; only the time is not convex and is searched. ``vehicle``:
    limits of the engine, mass at the start. ``limits``: tilt and glide slope. ``steps``: n."""

    def __init__(self, vehicle: Vehicle, limits: Limits, steps: int = 30) -> None:
        self.vehicle, self.limits, self.steps = vehicle, limits, steps
        try:
            import cvxpy
        except ImportError:
            msg = "the convex reference needs the extra 'guidance': pip install"
            raise QuadtreeLssError(f"{msg} 'quadtree_lss[guidance]'") from None
        self._cvxpy: Any = cvxpy

    def cheapest(
        self, position: Array, velocity: Array, end: Array, end_velocity: Array
    ) -> Optimum | None:
        """The descent that burns least, with the best time to 0.5 s; None if there is none."""
        found: dict[float, Optimum | None] = {}

        def cost(seconds: float) -> float:
            if seconds not in found:
                found[seconds] = self.within(seconds, position, velocity, end, end_velocity)
            best = found[seconds]
            return np.inf if best is None else best.propellant

        grid = np.arange(8.0, 96.0, 8.0)
        costs: list[float] = []
        for t in grid:  # the cost has one valley
            costs.append(cost(float(t)))
            if len(costs) > 1 and costs[-2] < costs[-1] < np.inf:
                break
        if not np.isfinite(costs).any():
            return None
        middle, step = float(grid[int(np.argmin(costs))]), 4.0
        while step >= 0.5:
            middle = min((middle - step, middle, middle + step), key=cost)
            step /= 2.0
        return found[middle]

    def within(
        self, seconds: float, position: Array, velocity: Array, end: Array, end_velocity: Array
    ) -> Optimum | None:
        """The descent that burns least in a given time, None if there is none."""
        cp, vehicle, n = self._cvxpy, self.vehicle, self.steps
        dt, speed = seconds / n, vehicle.exhaust_speed
        r, v, u = cp.Variable((n + 1, 3)), cp.Variable((n + 1, 3)), cp.Variable((n + 1, 3))
        size = cp.Variable(n + 1)
        burn = cp.hstack([0.0, cp.cumsum(0.5 * dt * (size[:-1] + size[1:]))])
        rules = [r[0] == position, v[0] == velocity]
        # Acceleration is linear within a step.
        rules.append(v[1:] == v[:-1] + dt * (0.5 * (u[:-1] + u[1:]) + vehicle.weight))
        half = dt * dt * (u[:-1] / 3.0 + u[1:] / 6.0 + 0.5 * vehicle.weight)
        rules.append(r[1:] == r[:-1] + dt * v[:-1] + half)
        rules.append(cp.norm(u, axis=1) <= size)
        rules.append(u[:, 2] >= np.cos(np.radians(vehicle.tilt_max_deg)) * size)
        # Thrust over mass between its limits: the logarithm of the mass about that of hovering.
        times = dt * np.arange(n + 1)
        guess = np.log(vehicle.mass) - vehicle.gravity * times / speed
        off = np.log(vehicle.mass) - burn / speed - guess
        low, high = vehicle.thrust_min * np.exp(-guess), vehicle.thrust_max * np.exp(-guess)
        rules.append(size <= cp.multiply(high, 1.0 - off))
        rules.append(size >= cp.multiply(low, 1.0 - off))
        rules += [r[n] == end, v[n] == end_velocity]
        slope = np.tan(np.radians(self.limits.glide_slope_deg))
        rules += [slope * cp.norm(r[k, :2] - end[:2]) <= r[k, 2] - end[2] for k in range(1, n)]
        problem = cp.Problem(cp.Minimize(burn[n]), rules)
        problem.solve(solver=cp.CLARABEL, canon_backend=cp.SCIPY_CANON_BACKEND)
        if problem.status != cp.OPTIMAL:
            return None
        mass = vehicle.mass * np.exp(-burn.value / speed)
        thrust = np.asarray(size.value) * mass
        return Optimum(vehicle.mass - mass[n], seconds, r.value, v.value, thrust)
