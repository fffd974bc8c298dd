# SPDX-License-Identifier: Apache-2.0
"""The vehicle does no more than its limits allow, and burns what the rocket equation says."""

import numpy as np
import pytest

from quadtree_lss.lab.flight.vehicle import Vehicle, VehicleState

DT = 0.01


def at_rest(vehicle, command=None, steps=0):
    """100 m up; so many steps after a command."""
    lander = VehicleState(vehicle, np.array([0.0, 0.0, 100.0]), np.zeros(3))
    if command is not None:
        lander.command(np.array(command))
    for _ in range(steps):
        lander.step(DT)
    return lander


def test_thrust_and_tilt_change_no_faster_than_they_can():
    vehicle = Vehicle()
    lander = at_rest(vehicle, [1e5, 0.0, 1e3])
    thrust, tilt = [lander.thrust], [lander.tilt_deg]
    for _ in range(500):
        lander.step(DT)
        thrust.append(lander.thrust)
        tilt.append(lander.tilt_deg)
    assert np.abs(np.diff(thrust)).max() <= vehicle.thrust_rate * DT + 1e-6
    assert np.abs(np.diff(tilt)).max() <= vehicle.tilt_rate_deg * DT + 1e-6
    assert thrust[-1] == vehicle.thrust_max
    assert tilt[-1] == pytest.approx(vehicle.tilt_max_deg)


def test_a_command_has_no_effect_before_the_delay():
    thrusts = [at_rest(Vehicle(delay=0.1), [0, 0, 6e3], steps).thrust for steps in (0, 10, 11)]
    assert thrusts[0] == thrusts[1] < thrusts[2]


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
