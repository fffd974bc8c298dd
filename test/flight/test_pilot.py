# SPDX-License-Identifier: Apache-2.0
"""What the pilot does with targets: takes, changes, loses them; and when it does so no more."""

import numpy as np
import pytest

from quadtree_lss.lab.flight.pilot import Pilot, Rules
from quadtree_lss.lab.flight.vehicle import Vehicle, VehicleState

VEHICLE, RULES, COMMIT = Vehicle(), Rules(), 20.0


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
    return np.array([x, y, 0.0])


def whats(pilot):
    return [d.what for d in pilot.decisions]


@pytest.mark.parametrize(
    ("below", "heard", "ends", "done"),
    [
        (None, None, (8.0, -6.0), ["target", "gate"]),
        (60.0, at(-3.0, 10.0), (-3.0, 10.0), ["target", "divert", "gate"]),
        (COMMIT - 0.5, at(17.0, -3.0), (8.0, -6.0), ["target", "too late", "gate"]),
    ],
    ids=["one target", "another while it is high", "another below the latest height"],
)
def test_it_comes_down_softly_on_the_target(below, heard, ends, done):
    course = Course()
    course.fly(2.0).pilot.on_selected(at(8.0, -6.0))
    if heard is not None:
        course.below(below).pilot.on_selected(heard)
    course.fly()
    assert np.hypot(*(course.lander.position[:2] - ends)) < 0.1
    assert 0.8 < -course.lander.velocity[2] < 1.6
    assert np.hypot(*course.lander.velocity[:2]) < 0.1 and course.lander.tilt_deg < 3.0
    assert whats(course.pilot) == done


def test_a_target_out_of_reach_is_not_flown_to():
    course = Course()
    course.fly(2.0).pilot.on_selected(at(0.0, 0.0))
    course.below(30.0).pilot.on_selected(at(400.0, 0.0))
    assert "out of reach" in whats(course.pilot)
    np.testing.assert_array_equal(course.pilot.aim, np.zeros(3))


def test_without_a_target_it_hovers_and_in_the_end_leaves():
    course = Course().fly(120.0, until=lambda c: c.pilot.mode == "abort")
    assert whats(course.pilot) == ["hover", "abort"]
    assert course.lowest > COMMIT
    assert abs(course.lander.position[2] - RULES.hover) < 3.0


@pytest.mark.parametrize(
    ("height", "then", "said"), [(28.0, 8.0, "hover"), (14.0, 1.0, "too late")]
)
def test_one_that_is_lost_leads_up_or_to_a_hover_and_the_next_one_down(height, then, said):
    """Lost low, it is left upwards before another is flown to."""
    course = Course()
    course.fly(2.0).pilot.on_selected(at(3.0, 0.0))
    course.below(height).pilot.on_selected(None)
    course.fly(then).pilot.on_selected(at(12.0, 0.0))
    assert said in whats(course.pilot)
    course.fly(15.0).pilot.on_selected(at(12.0, 0.0))
    course.fly()
    assert course.lowest <= 0.0
    assert np.hypot(*(course.lander.position[:2] - [12.0, 0.0])) < 0.1
