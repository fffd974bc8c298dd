# SPDX-License-Identifier: Apache-2.0
"""State machine of the landing, with a first-order point mass in simulated time."""

import math

import numpy as np
import pytest

from quadtree_lss.onboard.autopilot import inputs as limits
from quadtree_lss.onboard.autopilot import landing
from quadtree_lss.onboard.autopilot.inputs import Inputs, Target, target_from_status
from quadtree_lss.onboard.autopilot.landing import Landing
from quadtree_lss.onboard.config.sections import AutopilotConfig
from quadtree_lss.onboard.core.landing.target import Reason
from quadtree_lss.onboard.messages.maps import STATUS_FIELDS

PILOT, WAIT, CLIMB, TRANSIT, DESCEND, COMMIT, TOUCHDOWN, HOLD, WAVE_OFF, GIVE_UP = landing.STATES
CONFIG = AutopilotConfig()
GROUND = 1.5
SITE = np.array([0.0, 0.0, GROUND])


class Flight:
    """Simulated vehicle and inputs; tests change the inputs during the flight."""

    def __init__(self, place=(10.0, 5.0, 25.0), config=CONFIG):
        self.landing = Landing(config)
        self.position, self.velocity, self.now = np.array(place, float), np.zeros(3), 0.0
        self.ours = self.armed = True
        self.target, self.target_age, self.map_age, self.why = SITE, 0.2, 0.3, "withdrawn"
        self.heartbeat_age, self.pose_age, self.jump = 0.3, 0.02, 0.0
        self.says, self.offset, self.ground = None, math.nan, GROUND
        self.landed, self.landed_at = False, 0.0
        self.wind, self.seen = np.zeros(3), (self.position, self.velocity)
        self.states, self.order, self.goal = [], None, None

    @property
    def height(self):
        return self.position[2] - GROUND

    def step(self):
        target = None
        if self.target is not None:
            target = Target(self.target, self.target_age, self.map_age, self.offset)
        if self.pose_age <= limits.POSE_S:
            self.seen = self.position.copy(), self.velocity.copy()
        down = bool(self.position[2] <= self.ground + 1e-6)
        landed = down if self.says is None else self.says
        if landed is not self.landed:
            self.landed, self.landed_at = landed, self.now
        seen = Inputs(
            self.now, self.ours, self.armed, landed, self.now - self.landed_at, self.heartbeat_age,
            self.pose_age, *self.seen, self.jump, target, self.why,
        )  # fmt: skip
        self.order = self.landing.step(seen)
        # Where it is to sink, PX4 may take it for landed and stop its motors.
        assert not self.order.sink or self.order.state in (COMMIT, TOUCHDOWN)
        if not self.states or self.states[-1] != self.order.state:
            self.states.append(self.order.state)
        if self.order.point is not None:
            self.goal = self.order.point
        elif not self.ours:
            self.goal = None
        for _ in range(10):
            wanted = np.zeros(3) if self.goal is None else 1.5 * (self.goal - self.position)
            self.velocity += (np.clip(wanted, -4.0, 4.0) + self.wind - self.velocity) * 0.06
            if down and self.landed:  # ArduCopter does not lift off by a set-point
                self.velocity[:] = 0.0
            self.position += 0.01 * self.velocity
            if self.position[2] <= self.ground:
                self.position[2], self.velocity[:], down = self.ground, 0.0, True
        self.now += 0.1

    def until(self, condition, seconds=90.0):
        """Fly until the condition is true."""
        end = self.now + seconds
        while not condition(self):
            assert self.now < end, (self.states, self.order, self.position)
            self.step()
        return self

    def on(self, seconds):
        """Fly for a time, s."""
        end = self.now + seconds
        while self.now < end:
            self.step()
        return self


def in_state(state):
    return lambda flight: flight.order is not None and flight.order.state == state


def below(height):
    return lambda flight: flight.height < height


def test_complete_landing():
    flight = Flight().until(in_state(DESCEND))
    assert flight.height > CONFIG.gate_height - 1.0 and np.hypot(*flight.position[:2]) < 0.5
    began = flight.now
    flight.until(in_state(COMMIT))
    took = (1.0 - landing.COMMIT_SHARE) * CONFIG.gate_height / CONFIG.descent_speed
    assert flight.now - began == pytest.approx(took, abs=2.5)
    flight.until(below(1.0)).on(0.5)
    assert flight.velocity[2] == pytest.approx(-CONFIG.touchdown_speed, rel=0.3)
    assert flight.order.sink == CONFIG.touchdown_speed
    flight.until(in_state(TOUCHDOWN))
    assert flight.on(0.1).order.sink == CONFIG.touchdown_speed, "until it stops its motors"
    assert flight.states == [TRANSIT, DESCEND, COMMIT, TOUCHDOWN]
    assert np.hypot(*flight.position[:2]) < 0.02
    assert flight.order.point[2] < GROUND, "it goes on pressing on the ground"
    flight.ours = False
    assert flight.on(1.0).order.state == TOUCHDOWN, "land mode, which it asked for, is no pilot"
    flight.armed = False
    flight.step()
    assert flight.order.state == TOUCHDOWN and flight.order.point is None


def test_climb_from_below_the_gate():
    flight = Flight((10.0, 5.0, GROUND + 3.0)).until(in_state(TRANSIT))
    assert flight.states[0] == CLIMB and np.hypot(*(flight.position - (10, 5, 0))[:2]) < 0.2
    assert flight.height > CONFIG.gate_height - 1.1


@pytest.mark.parametrize("height", [6.0, 3.0, 1.2, 0.4])
@pytest.mark.parametrize(
    "fault",
    [
        {"target": None},
        {"target_age": landing.TARGET_S + 0.1},
        {"target": SITE + (4.0, 0.0, 0.0)},
        {"target": SITE + (-80.0, 0.0, 0.0)},
        {"target": SITE + (0.0, 0.0, 15.0)},
    ],
    ids=["withdrawn", "silent", "moved", "out of reach", "above"],
)
def test_loss_below_the_gate_leads_to_a_climb(height, fault):
    flight = Flight().until(below(height))
    place, lowest = flight.position.copy(), []
    for name, value in fault.items():
        setattr(flight, name, value)
    for _ in range(80):
        flight.step()
        lowest.append(flight.height)
        if flight.order.state == TRANSIT:
            break
    # It falls on for what its speed takes to turn, and comes down nowhere.
    assert WAVE_OFF in flight.states and flight.landing.wave_offs == 1
    assert min(lowest) > height - 0.35 and min(lowest) > 0.0
    assert lowest[-1] > CONFIG.gate_height - 1.2
    assert np.hypot(*(flight.position - place)[:2]) < 0.5, "straight up"
    if "moved" not in str(flight.order.text) and np.array_equal(flight.target, SITE + (4, 0, 0)):
        flight.until(in_state(TOUCHDOWN))
        assert np.hypot(*(flight.position - flight.target)[:2]) < 0.05
    else:
        flight.on(5.0)
        assert flight.order.state == HOLD and flight.order.target is None


@pytest.mark.parametrize("age", [landing.MAP_S + 0.1, -landing.MAP_S - 0.1, math.nan])
def test_old_map_stops_a_descent_before_commit_only(age):
    flight = Flight().until(in_state(DESCEND)).on(2.0)
    flight.map_age = age
    flight.until(in_state(HOLD))
    assert flight.states[-2:] == [WAVE_OFF, HOLD] and "map" in flight.order.text
    flight = Flight().until(in_state(COMMIT))
    flight.map_age = age
    assert flight.until(in_state(TOUCHDOWN)).landing.wave_offs == 0


def test_old_pose_holds_the_last_known_position():
    flight = Flight().until(below(4.0))
    place = flight.seen[0]
    flight.pose_age = limits.POSE_S + 0.01
    flight.step()
    assert flight.order.state == HOLD
    np.testing.assert_array_equal(flight.order.point, place)
    assert flight.order.target is None, "where it lies from the vehicle, nobody knows"
    flight.on(3.0)
    np.testing.assert_array_equal(flight.order.point, place)
    flight.pose_age = 0.02
    flight.until(in_state(WAVE_OFF)).until(in_state(DESCEND)).until(in_state(TOUCHDOWN))
    flight = Flight().until(below(4.0))
    flight.pose_age = 1e3
    flight.until(in_state(GIVE_UP))
    assert flight.height > 3.5


def test_vehicle_that_landed_without_link_or_pose_stays_down():
    flight = Flight().until(below(0.15))
    flight.heartbeat_age = landing.HEARTBEAT_S + 0.1
    assert flight.on(2.0).height == 0.0, "to the last set-point, which is below the ground"
    flight.heartbeat_age = 0.1
    assert flight.on(limits.STILL_S + 0.5).order.state == TOUCHDOWN and flight.height == 0.0
    assert flight.order.point[2] < GROUND and WAVE_OFF not in flight.states
    for fault in ({"pose_age": limits.POSE_S + 0.1}, {"jump": landing.JUMP_M + 0.1}):
        flight = Flight().until(below(1e-6))
        for name, value in fault.items():
            setattr(flight, name, value)
        assert flight.on(1.0).order.state == TOUCHDOWN
    flight = Flight().until(below(4.0))
    for pose_age in (limits.POSE_S + 0.1, limits.POSE_S + 0.1, 0.02):  # it came down unseen
        flight.position[2], flight.pose_age = GROUND, pose_age
        flight.velocity[:] = 0.0
        flight.step()
    assert flight.order.state == TOUCHDOWN and flight.order.point[2] < GROUND


@pytest.mark.parametrize("fault", [{"target": None}, {"jump": landing.JUMP_M + 0.1}])
def test_ground_contact_during_a_wave_off_ends_the_flight(fault):
    """ArduCopter does not take off for a set-point; it would stay there with running motors."""
    flight = Flight().until(below(0.05))
    for name, value in fault.items():
        setattr(flight, name, value)
    flight.step()
    assert flight.order.state in (WAVE_OFF, GIVE_UP)
    flight.position[2], flight.velocity[:], flight.jump = GROUND, 0.0, 0.0
    assert flight.on(limits.STILL_S + 0.5).order.state == TOUCHDOWN and flight.height == 0.0


def test_no_command_without_heartbeats_and_a_climb_afterwards():
    flight = Flight().until(below(4.0))
    flight.heartbeat_age = landing.HEARTBEAT_S + 0.1
    flight.on(1.0)
    assert flight.order.point is None and flight.order.target is None
    flight.heartbeat_age = 0.1
    flight.on(0.3)
    assert flight.order.state == WAVE_OFF


@pytest.mark.parametrize("state", [TRANSIT, DESCEND, COMMIT, HOLD, WAVE_OFF, GIVE_UP])
def test_mode_change_by_the_pilot_ends_control(state):
    flight = Flight()
    if state in (HOLD, WAVE_OFF):
        flight.until(in_state(DESCEND)).on(2.0).target = None
    if state == GIVE_UP:
        flight.step()
        flight.jump = 9.0
    flight.until(in_state(state))
    flight.ours = False
    flight.step()
    assert flight.order.state == PILOT
    assert flight.order.point is None and flight.order.target is None
    flight.ours, flight.jump, flight.target = True, 0.0, None
    flight.until(in_state(WAIT), landing.STEADY_S + 0.5)
    assert flight.order.state == WAIT and flight.landing.wave_offs == 0
    np.testing.assert_allclose(flight.order.point, flight.goal)


def test_navigation_jump_leads_to_give_up():
    flight = Flight().until(below(4.0))
    flight.jump = landing.JUMP_M + 0.01
    flight.step()
    flight.jump = 0.0
    flight.on(10.0)
    assert flight.order.state == GIVE_UP and "jumped" in flight.order.text
    assert flight.height == pytest.approx(CONFIG.gate_height, abs=0.1)
    assert flight.on(60.0).order.state == GIVE_UP, "until the pilot has taken over"
    assert flight.order.target is None, "whoever takes over by LAND does not land there"
    flight = Flight().until(below(4.0))
    flight.heartbeat_age, flight.jump = landing.HEARTBEAT_S + 0.1, landing.JUMP_M + 0.01
    flight.step()
    assert flight.order.point is None
    flight.heartbeat_age, flight.jump = 0.1, 0.0
    assert flight.on(1.0).order.state == GIVE_UP, "seen while the link was bad"


def test_limits_of_waiting_and_of_wave_offs():
    flight = Flight()
    flight.target = None
    flight.on(landing.WAIT_LIMIT_S - 1.0)
    assert flight.order.state == WAIT
    np.testing.assert_allclose(flight.position, [10.0, 5.0, 25.0], atol=1e-9)
    assert flight.on(2.0).order.state == GIVE_UP
    flight = Flight()
    for _ in range(landing.MAX_WAVE_OFFS + 1):
        flight.until(in_state(DESCEND)).on(1.0)
        flight.target = None
        flight.step()
        flight.target = SITE
    assert flight.order.state == GIVE_UP
    assert flight.on(60.0).height == pytest.approx(CONFIG.gate_height, abs=0.1)


def test_no_descent_beside_the_target():
    flight = Flight().until(in_state(DESCEND)).on(2.0)
    flight.wind = np.array([1.5, 0.0, 0.0])  # it is blown a metre off, and stays so
    flight.on(3.0)
    height = flight.height
    assert np.hypot(*flight.position[:2]) > limits.OFFSET_M
    assert flight.on(20.0).height > height - 0.3 and flight.order.state == DESCEND
    flight.wind[:] = 0.0
    flight.until(in_state(COMMIT))
    flight.wind = np.array([2.5, 0.0, 0.0])
    flight.until(in_state(WAVE_OFF))
    assert flight.height > 0.5


def test_last_set_point_before_commit_is_above_the_ground():
    """An autopilot that receives nothing more flies to the last set-point and stays there."""
    flight = Flight().until(in_state(DESCEND))
    while flight.order.state == DESCEND:
        assert flight.order.point[2] >= GROUND + landing.COMMIT_SHARE * CONFIG.gate_height - 1e-9
        flight.step()
    while flight.order.state == COMMIT:
        assert flight.order.point[2] >= flight.position[2] - 2.0 * CONFIG.touchdown_speed - 0.6
        flight.step()


def test_small_shift_of_the_target_is_followed():
    flight = Flight().until(in_state(DESCEND))
    flight.target = SITE + (0.3, 0.0, 0.1)
    flight.until(in_state(TOUCHDOWN))
    assert WAVE_OFF not in flight.states
    assert flight.position[0] == pytest.approx(0.3, abs=0.02)


def test_handover_with_an_old_pose_commands_nothing():
    flight = Flight()
    flight.pose_age = 60.0
    assert flight.on(2.0).order.state == PILOT and flight.order.point is None
    assert "pose" in flight.order.text
    flight.pose_age = 0.02
    flight.until(in_state(TOUCHDOWN))


def test_no_takeoff():
    flight = Flight((0.0, 0.0, GROUND))
    assert flight.on(2.0).order.state == PILOT and flight.order.point is None
    flight = Flight()
    flight.armed = False
    assert flight.on(2.0).order.point is None


def test_invalid_place_withdraws_the_target_with_its_reason():
    status = np.zeros(1, STATUS_FIELDS)[0]
    status["reason"], status["offset_z"], status["age"] = Reason.HAZARD, math.nan, 0.5
    for place in ((math.nan,) * 3, (1e300, 0.0, 0.0)):
        target, why = target_from_status(np.array(place), status, 0.1, 0.2)
        assert target is None and why.startswith("there is no target: ") and "unknown" not in why
    status["offset_z"] = 2.0
    target, why = target_from_status(SITE, status, 0.1, 0.2)
    np.testing.assert_array_equal(target.place, SITE + (0.0, 0.0, 2.0))
    assert (target.age, target.map_age, why) == (0.1, 0.7, "")
