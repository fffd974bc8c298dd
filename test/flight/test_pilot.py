# SPDX-License-Identifier: Apache-2.0
"""What the pilot does with targets: takes, changes, loses them; and when it does so no more."""

import numpy as np

from quadtree_lss.lab.flight.pilot import Pilot, Rules, Target
from quadtree_lss.lab.flight.vehicle import Vehicle, VehicleState

VEHICLE, RULES, COMMIT = Vehicle(), Rules(), 20.0
NONE = Target(None)


class Course:
    """A lander flown by the pilot, without navigation errors."""

    def __init__(self, position=(-260.0, 0.0, 150.0), velocity=(24.0, 0.0, -14.0)):
        self.lander = VehicleState(VEHICLE, np.array(position), np.array(velocity))
        self.pilot = Pilot(VEHICLE, RULES, np.zeros(3), avoid=True, commit_height=COMMIT)
        self.ticks, self.lowest = 0, np.inf

    def fly(self, seconds=100.0, until=lambda course: False):
        end = self.ticks + round(seconds * 100)
        while self.ticks < end and self.lander.position[2] > 0.0 and not until(self):
            lander = self.lander
            if self.ticks % 10 == 0:
                now = 0.01 * self.ticks
                state = lander.position.copy(), lander.velocity.copy()
                lander.command(self.pilot.guide(now, *state, lander.mass))
            lander.step(0.01)
            self.lowest = min(self.lowest, lander.position[2])
            self.ticks += 1
        return self

    def below(self, height):
        return self.fly(until=lambda course: course.lander.position[2] <= height)


def at(x, y):
    return Target(np.array([x, y, 0.0]))


def whats(pilot):
    return [d.what for d in pilot.decisions]


def test_it_comes_down_softly_on_the_target():
    course = Course()
    course.fly(2.0).pilot.hear(at(8.0, -6.0))
    course.fly()
    assert np.hypot(*(course.lander.position[:2] - [8.0, -6.0])) < 0.1
    assert 0.8 < -course.lander.velocity[2] < 1.6
    assert np.hypot(*course.lander.velocity[:2]) < 0.1 and course.lander.tilt_deg < 3.0


def test_it_diverts_to_another_target_while_it_is_high():
    course = Course()
    course.fly(2.0).pilot.hear(at(8.0, -6.0))
    course.below(60.0).pilot.hear(at(-3.0, 10.0))
    course.fly()
    assert np.hypot(*(course.lander.position[:2] - [-3.0, 10.0])) < 0.1
    assert whats(course.pilot) == ["target", "divert", "gate"]


def test_below_the_latest_height_it_does_not_divert():
    course = Course()
    course.fly(2.0).pilot.hear(at(3.0, 0.0))
    course.below(COMMIT - 0.5).pilot.hear(at(9.0, 3.0))
    course.fly()
    assert np.hypot(*(course.lander.position[:2] - [3.0, 0.0])) < 0.1
    assert "too late" in whats(course.pilot) and "divert" not in whats(course.pilot)


def test_a_target_out_of_reach_is_not_flown_to():
    course = Course()
    course.fly(2.0).pilot.hear(at(0.0, 0.0))
    course.below(30.0).pilot.hear(at(400.0, 0.0))
    assert "out of reach" in whats(course.pilot)
    np.testing.assert_array_equal(course.pilot.aim, np.zeros(3))


def test_without_a_target_it_hovers_and_in_the_end_leaves():
    course = Course().fly(120.0, until=lambda c: c.pilot.mode == "abort")
    assert whats(course.pilot) == ["hover", "abort"]
    assert course.lowest > COMMIT
    assert abs(course.lander.position[2] - RULES.hover) < 3.0


def test_a_target_that_is_lost_leads_to_a_hover_and_the_next_one_down():
    course = Course()
    course.fly(2.0).pilot.hear(at(3.0, 0.0))
    course.below(28.0).pilot.hear(NONE)
    course.fly(8.0)
    assert course.pilot.mode == "hover"
    course.pilot.hear(at(-6.0, 5.0))
    course.fly()
    assert np.hypot(*(course.lander.position[:2] - [-6.0, 5.0])) < 0.1


def test_one_that_is_lost_low_is_left_upwards_before_another_is_flown_to():
    course = Course()
    course.fly(2.0).pilot.hear(at(3.0, 0.0))
    course.below(14.0).pilot.hear(NONE)
    course.fly(1.0).pilot.hear(at(12.0, 0.0))
    assert whats(course.pilot)[-1] == "too late"
    course.fly(15.0).pilot.hear(at(12.0, 0.0))
    course.fly()
    assert course.lowest <= 0.0
    assert np.hypot(*(course.lander.position[:2] - [12.0, 0.0])) < 0.1


def test_what_it_says_it_reaches_it_reaches():
    course = Course().fly(3.0)
    area = course.pilot.area()
    inner = area - RULES.zone * area / np.linalg.norm(area, axis=1)[:, None]
    far = inner[np.argmax(np.linalg.norm(inner, axis=1))]
    assert np.linalg.norm(far) > 15.0
    course.pilot.hear(at(*(0.98 * far)))
    course.fly()
    assert np.hypot(*(course.lander.position[:2] - 0.98 * far)) < 0.3


def test_it_waits_at_the_gate_until_it_is_over_the_aim():
    """Pushed aside there, as by a navigation that jumps, it still comes down softly on it."""
    course = Course()
    course.fly(2.0).pilot.hear(at(3.0, 0.0))
    course.fly(until=lambda c: c.pilot.mode == "terminal")
    course.lander.position[0] += 3.0
    course.lander.velocity[0] += 1.0
    course.fly()
    assert np.hypot(*(course.lander.position[:2] - [3.0, 0.0])) < 0.3
    assert np.hypot(*course.lander.velocity[:2]) < 0.3 and course.lander.tilt_deg < 6.0


def test_it_says_nothing_new_when_it_is_low():
    course = Course()
    course.fly(2.0).pilot.hear(at(3.0, 0.0))
    course.below(COMMIT - 1.0)
    assert course.pilot.area() is None
