# SPDX-License-Identifier: Apache-2.0
"""The vehicle does no more than its limits allow, and burns what the rocket equation says."""

import numpy as np
import pytest

from quadtree_lss.lab.flight.vehicle import Vehicle, VehicleState

DT = 0.01


def at_rest(vehicle):
    return VehicleState(vehicle, np.array([0.0, 0.0, 100.0]), np.zeros(3))


def test_thrust_and_tilt_change_no_faster_than_they_can():
    vehicle = Vehicle()
    lander = at_rest(vehicle)
    lander.command(np.array([1e5, 0.0, 1e3]))
    thrust, tilt = [lander.thrust], [lander.tilt_deg]
    for _ in range(500):
        lander.step(DT)
        thrust.append(lander.thrust)
        tilt.append(lander.tilt_deg)
    assert np.abs(np.diff(thrust)).max() <= vehicle.thrust_rate * DT + 1e-6
    assert np.abs(np.diff(tilt)).max() <= vehicle.tilt_rate_deg * DT + 1e-6
    assert thrust[-1] == vehicle.thrust_max
    assert tilt[-1] == pytest.approx(vehicle.tilt_max_deg)


def test_the_engine_is_never_off():
    lander = at_rest(Vehicle())
    lander.command(np.zeros(3))
    for _ in range(200):
        lander.step(DT)
    assert lander.thrust == Vehicle().thrust_min


def test_a_command_has_no_effect_before_the_delay():
    lander = at_rest(Vehicle(delay=0.1))
    before = lander.thrust
    lander.command(np.array([0.0, 0.0, 6000.0]))
    for _ in range(10):
        lander.step(DT)
        assert lander.thrust == before
    lander.step(DT)
    assert lander.thrust > before


def test_hovering_stays_and_burns_by_the_rocket_equation():
    vehicle = Vehicle(delay=0.0)
    lander = at_rest(vehicle)
    seconds = 20.0
    for _ in range(round(seconds / DT)):
        lander.command(np.array([0.0, 0.0, lander.mass * vehicle.gravity]))
        lander.step(DT)
    assert lander.position == pytest.approx([0.0, 0.0, 100.0], abs=0.01)
    change = vehicle.gravity * seconds
    left = vehicle.mass * np.exp(-change / vehicle.exhaust_speed)
    assert lander.mass == pytest.approx(left, rel=1e-4)


def test_without_propellant_it_falls():
    vehicle = Vehicle(propellant=0.5)
    lander = at_rest(vehicle)
    for _ in range(300):
        lander.step(DT)
    assert lander.thrust == 0.0 and lander.velocity[2] < -1.0
