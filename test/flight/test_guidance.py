# SPDX-License-Identifier: Apache-2.0
"""ZEM/ZEV leads where it says, costs what it says, and keeps the limits it was given."""

import numpy as np
import pytest

from quadtree_lss.lab.flight.guidance import Limits, limited_thrust, paths, zem_zev
from quadtree_lss.lab.flight.vehicle import Vehicle

VEHICLE = Vehicle()
START = np.array([-510.0, 20.0, 300.0])
SPEED = np.array([34.0, -1.0, -20.0])
END, DOWN = np.array([5.0, -8.0, 8.0]), np.array([0.0, 0.0, -1.5])
LIMITS = Limits()


def flown(seconds, dt=0.002):
    """Mass, position, velocity and greatest and least thrust of a path that is followed exactly."""
    position, velocity, mass = START.copy(), SPEED.copy(), VEHICLE.mass
    sizes = []
    for k in range(round(seconds / dt) - 2):
        push, _ = zem_zev(position, velocity, END, DOWN, seconds - k * dt, VEHICLE.weight)
        change = push + VEHICLE.weight
        position += velocity * dt + 0.5 * change * dt * dt
        velocity += change * dt
        size = float(np.linalg.norm(push))
        sizes.append(size * mass)
        mass -= mass * size * dt / VEHICLE.exhaust_speed
    return mass, position, velocity, sizes


def ways(times, limits=LIMITS, ends=(END,), began=(START, SPEED)):
    """What it takes in such times."""
    return paths(VEHICLE, VEHICLE.mass, *began, np.array(ends), DOWN, np.array(times), limits)


def test_it_ends_where_and_as_fast_as_asked_and_costs_what_was_said():
    seconds = 32.0
    mass, position, velocity, _ = flown(seconds)
    np.testing.assert_allclose(position, END, atol=0.05)
    np.testing.assert_allclose(velocity, DOWN, atol=0.05)
    found = ways([seconds])
    assert found.propellant[0, 0] == pytest.approx(VEHICLE.mass - mass, rel=5e-3)


def test_what_is_allowed_keeps_the_engine_within_its_limits():
    found = ways(np.arange(15.0, 60.0))
    assert found.allowed.any() and not found.allowed.all()
    seconds, propellant = found.best()
    assert propellant == found.propellant[found.allowed].min()
    sizes = flown(seconds)[3]
    assert min(sizes) >= VEHICLE.thrust_min and max(sizes) <= VEHICLE.thrust_max


@pytest.mark.parametrize("limits", [Limits(tilt_deg=5.0), Limits(thrust_share=0.4)])
def test_a_limit_that_cannot_be_kept_leaves_no_path(limits):
    assert ways(np.arange(15.0, 60.0), limits).best() is None


def test_a_place_behind_the_vehicle_is_out_of_reach():
    behind = START + np.array([-200.0, 0.0, -290.0])
    found = ways(np.arange(5.0, 60.0), ends=(END, behind))
    assert found.best(0) is not None and found.best(1) is None


def test_thrust_is_cut_across_before_it_is_cut_upwards():
    thrust = limited_thrust(VEHICLE, 1800.0, np.array([5.0, 0.0, 3.0]))
    assert thrust[2] == pytest.approx(1800.0 * 3.0)
    assert np.linalg.norm(thrust) <= VEHICLE.thrust_max * (1.0 + 1e-9)
    assert thrust[0] > 0.0


def test_a_path_that_sinks_below_the_glide_slope_is_not_allowed():
    """From straight above on the cone's edge, fast downwards: it would arrive from the side."""
    began = np.array([-100.0, 0.0, 115.0]), np.array([10.0, 0.0, -15.0])
    shallow, steep = (
        ways(np.arange(8.0, 40.0, 0.5), Limits(glide_slope_deg=slope), np.zeros((1, 3)), began)
        for slope in (5.0, 45.0)
    )
    assert shallow.allowed.sum() > steep.allowed.sum() > 0
