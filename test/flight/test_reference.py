# SPDX-License-Identifier: Apache-2.0
"""The convex reference is feasible, no guidance burns less, and one axis agrees with bang-bang."""

import numpy as np
import pytest
from scipy.optimize import brentq

from quadtree_lss.lab.flight.guidance import Limits, paths
from quadtree_lss.lab.flight.pilot import Pilot, Rules
from quadtree_lss.lab.flight.vehicle import Vehicle

pytest.importorskip("cvxpy")
from quadtree_lss.lab.flight.reference import Descent

VEHICLE, LIMITS = Vehicle(), Limits()
START, SPEED = np.array([-300.0, 10.0, 170.0]), np.array([26.0, 0.0, -14.0])
END, DOWN = np.array([4.0, -3.0, 8.0]), np.array([0.0, 0.0, -1.5])


@pytest.fixture(scope="module")
def best():
    return Descent(VEHICLE, LIMITS).cheapest(START, SPEED, END, DOWN)


def test_it_keeps_the_limits(best):
    np.testing.assert_allclose(best.position[[0, -1]], [START, END], atol=1e-4)
    np.testing.assert_allclose(best.velocity[[0, -1]], [SPEED, DOWN], atol=1e-4)
    assert best.thrust.max() <= VEHICLE.thrust_max * 1.01
    assert best.thrust.min() >= VEHICLE.thrust_min * 0.99
    away = best.position[1:-1] - END
    slope = np.tan(np.radians(LIMITS.glide_slope_deg))
    assert (away[:, 2] >= slope * np.hypot(away[:, 0], away[:, 1]) - 1e-3).all()


def test_no_path_of_the_guidance_burns_less(best):
    times = np.arange(10.0, 60.0, 0.5)
    loose = Limits(thrust_share=1.0, tilt_deg=VEHICLE.tilt_max_deg)
    found = paths(VEHICLE, VEHICLE.mass, START, SPEED, END[None], DOWN, times, loose).best()
    assert best.propellant <= found[1] <= 1.3 * best.propellant


def test_straight_down_it_is_least_thrust_then_greatest():
    """Of one axis the answer is known: fall, then brake; the switch is where both ends meet."""
    height, speed, dt = 120.0, -8.0, 1e-3

    def end(switch):
        z, v, mass, t = height, speed, VEHICLE.mass, 0.0
        while z > 0.0:
            thrust = VEHICLE.thrust_min if t < switch else VEHICLE.thrust_max
            v += dt * (thrust / mass - VEHICLE.gravity)
            z += dt * v
            mass -= dt * thrust / VEHICLE.exhaust_speed
            t += dt
            if v >= 0.0:
                break
        return z, mass

    def miss(switch):
        z, _ = end(switch)
        return z - 0.02

    switch = brentq(miss, 0.0, 15.0, xtol=1e-3)
    burnt = VEHICLE.mass - end(switch)[1]
    still = np.zeros(3)
    found = Descent(VEHICLE, LIMITS, steps=60).cheapest(
        np.array([0.0, 0.0, height]), np.array([0.0, 0.0, speed]), still, still
    )
    assert found.propellant == pytest.approx(burnt, rel=0.02)


def test_what_guidance_says_it_reaches_lies_within_what_can_be_reached():
    pilot = Pilot(VEHICLE, Rules(), np.zeros(3), avoid=True, commit_height=20.0)
    pilot.guide(0.0, START, SPEED, VEHICLE.mass)
    area = pilot.area()
    descent = Descent(VEHICLE, LIMITS)
    for k in (0, 3, 6, 9):
        heading = 2.0 * np.pi * k / len(area)
        along = np.array([np.cos(heading), np.sin(heading)])
        far = area[k] @ along - Rules().zone - 0.5
        end = np.array([*far * along, 8.0])
        found = (descent.within(t, START, SPEED, end, DOWN) for t in (18.0, 22.0, 26.0, 30.0))
        assert any(best is not None for best in found)
