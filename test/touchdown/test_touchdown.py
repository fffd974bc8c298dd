# SPDX-License-Identifier: Apache-2.0
"""Touchdowns with legs against what is reckoned by hand: drop, slide, tip-over."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="mujoco is not here: pip install 'quadtree_lss[physics]'")

from quadtree_lss.lab.simulation.hazard_field import FIELDS, hazard_field
from quadtree_lss.lab.simulation.terrain import SimulationError, Terrain
from quadtree_lss.lab.touchdown.legs import DRONE, FOOT, LANDER
from quadtree_lss.lab.touchdown.touchdown import Arrival, engine, placed, touch

AXIS = np.linspace(-10.0, 10.0, 201)
STIFF = replace(LANDER, crush=1e5)


def ground(slope_deg=0.0, size=1.0):
    """A plane that falls along x."""
    x = size * AXIS
    return Terrain(x, x, np.broadcast_to(-np.tan(np.radians(slope_deg)) * x, (201, 201)))


def across(slope_deg, speed=0.0):
    """Down a slope, upright to it."""
    t = np.radians(slope_deg)
    way, up = np.array([np.cos(t), 0.0, -np.sin(t)]), np.array([np.sin(t), 0.0, np.cos(t)])
    return Arrival(0.0, 0.0, speed * way, up)


def run(legs, terrain, arrival, seconds):
    """State after some seconds."""
    model, data, _ = placed(legs, terrain, arrival)
    engine().mj_step(model, data, round(seconds / model.opt.timestep))
    return data


@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_struts_crush_by_what_the_fall_had(speed):
    """m v^2 / 2 + m g s = 4 F s, of what is above the feet; these stop at once."""
    found = touch(LANDER, ground(), Arrival(0.0, 0.0, np.array([0.0, 0.0, -speed])))
    mass = LANDER.mass * (1.0 - 4.0 * FOOT)
    by_hand = 0.5 * mass * speed**2 / (4.0 * LANDER.crush - mass * LANDER.gravity)
    assert found.outcome == "stands" and found.stroke == pytest.approx(by_hand, rel=0.04)
    assert found.film[-1, 3] == pytest.approx(-by_hand, abs=0.008)
    assert found.tilt_deg < 0.05 and found.slid < 0.005


def test_energy_goes_into_struts_and_feet_alone():
    model, data, _ = placed(LANDER, ground(), Arrival(0.0, 0.0, np.array([0.0, 0.0, -1.5])))
    energy = [float(data.energy.sum())]
    for _ in range(300):
        engine().mj_step(model, data, 10)
        energy.append(float(data.energy.sum()))
    assert np.diff(energy).max() < 1e-3 * np.ptp(energy)
    crushed = LANDER.crush * data.qpos[7:].sum()
    feet = 4.0 * FOOT * LANDER.mass * 0.5 * 1.5**2
    assert energy[0] - energy[-1] == pytest.approx(crushed + feet, rel=0.04)


def test_a_drone_rests_on_its_springs():
    found = touch(DRONE, ground(size=0.3), Arrival(0.0, 0.0, np.array([0.0, 0.0, -0.5])))
    mass = DRONE.mass * (1.0 - 2.0 * FOOT)
    assert found.outcome == "stands" and found.tilt_deg < 0.1
    sunk = mass * DRONE.gravity / (2.0 * DRONE.stiffness)
    assert found.film[-1, 3] == pytest.approx(-sunk, abs=0.001)


def test_it_slides_down_as_friction_lets_it():
    """a = g (sin - mu cos)."""
    slope_deg, friction = 20.0, 0.2
    legs = replace(STIFF, friction=friction, centre=0.6)
    early, late = (run(legs, ground(slope_deg), across(slope_deg), s) for s in (0.5, 1.5))
    t = np.radians(slope_deg)
    by_hand = legs.gravity * (np.sin(t) - friction * np.cos(t))
    gained = np.linalg.norm(late.qvel[:3]) - np.linalg.norm(early.qvel[:3])
    assert gained == pytest.approx(by_hand, rel=0.03)


@pytest.mark.parametrize("speed", [0.8, 1.5])
def test_it_slides_out_as_far_as_friction_lets_it(speed):
    """d = v^2 / (2 mu g)."""
    legs = replace(STIFF, friction=0.4, centre=0.6)
    found = touch(legs, ground(), across(0.0, speed))
    assert found.slid == pytest.approx(speed**2 / (2.0 * 0.4 * legs.gravity), rel=0.05)
    assert found.outcome == ("slid" if found.slid > 0.5 else "stands")


def reach(legs):
    """From the middle to the rim of the pads that it tips over."""
    return legs.radius * np.sqrt(0.5) + legs.gear.pad_radius


@pytest.mark.parametrize(("off_deg", "outcome"), [(-1.5, "stands"), (2.0, "tipped")])
def test_it_tips_on_a_slope_on_which_its_weight_leaves_its_base(off_deg, outcome):
    """tan = half of the base over the height of the centre of mass."""
    legs = replace(STIFF, friction=2.0, centre=2.6)
    limit = np.degrees(np.arctan(reach(legs) / legs.centre))
    assert touch(legs, ground(limit + off_deg), across(limit + off_deg)).outcome == outcome


@pytest.mark.parametrize(("share", "outcome"), [(0.93, "stands"), (1.07, "tipped")])
def test_it_tips_over_feet_that_stop_at_once(share, outcome):
    """What turns about the rim, m v h, lifts the centre of mass over it: m g (L - h)."""
    legs = replace(STIFF, friction=20.0, centre=2.2)
    base, rest = reach(legs), legs.mass * (1.0 - 4.0 * FOOT)
    feet = legs.mass * FOOT * sum((base - x) ** 2 for x in legs.pads[:, 0])
    high = legs.centre * legs.mass / rest
    about = rest * (legs.gyration[0] ** 2 + base**2 + high**2) + feet
    lift = np.hypot(base, legs.centre) - legs.centre
    limit = np.sqrt(2.0 * about * legs.gravity * lift / legs.mass) / legs.centre
    assert touch(legs, ground(), across(0.0, share * limit)).outcome == outcome


def test_a_rough_ground_gives_no_energy():
    """Rocks, struts at their stops, a turn and a lean."""
    terrain = hazard_field(np.random.default_rng(5), replace(FIELDS["rough"], size=40.0))
    for k in range(4):
        arrival = replace(across(0.0, 1.0), x=3.0 * k, y=-2.0 * k, heading=0.7 * k)
        arrival = replace(arrival, velocity=np.array([0.6, 0.0, -2.5]), turn=np.array([0.1, 0, 0]))
        assert touch(LANDER, terrain, arrival).gained < 0.01


def test_a_rock_under_the_body_is_a_strike():
    level = ground()
    z = np.where(np.hypot(AXIS[None, :], AXIS[:, None]) < 0.25, 0.34, 0.0)
    found = touch(LANDER, replace(level, elevation=z), across(0.0))
    assert found.outcome == "body strike" and found.struck
    low = touch(LANDER, replace(level, elevation=0.8 * z), across(0.0))
    assert low.outcome == "stands" and not low.struck


def test_it_comes_down_on_its_pads_wherever_the_map_has_its_origin():
    z = np.broadcast_to(0.05 * AXIS + 1234.0, (201, 201))
    there = Terrain(AXIS + 5e4, AXIS - 3e4, z)
    arrival = Arrival(5e4 + 0.3, -3e4 - 0.2, np.array([0.0, 0.0, -1.0]), heading=0.4)
    far = touch(LANDER, there, arrival)
    near = touch(LANDER, Terrain(AXIS, AXIS, z), replace(arrival, x=0.3, y=-0.2))
    assert far.outcome == near.outcome == "stands"
    np.testing.assert_allclose(far.film[-1, 1:4] - [5e4, -3e4, 0], near.film[-1, 1:4], atol=0.01)
    rim = LANDER.radius * np.cos(0.25 * np.pi - 0.4) + LANDER.gear.pad_radius
    assert far.film[0, 3] == pytest.approx(1234.0 + 0.05 * (0.3 + rim), abs=0.01)
    assert far.tilt_deg == pytest.approx(np.degrees(np.arctan(0.05)), abs=0.5)
    assert touch(LANDER, there, arrival).film.tobytes() == far.film.tobytes()


def test_at_the_edge_it_stands_and_beside_the_terrain_there_is_one_line():
    down, edge = np.array([0.0, 0.0, -1.0]), AXIS[-1] - 0.5 * LANDER.gear.diameter
    assert touch(LANDER, ground(), Arrival(edge - 0.6, 0.0, down)).outcome == "stands"
    with pytest.raises(SimulationError, match="edge"):
        touch(LANDER, ground(), Arrival(edge - 0.4, 0.0, down))
