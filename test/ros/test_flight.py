# SPDX-License-Identifier: Apache-2.0
"""The same flight over DDS with the real nodes and in lock-step: only timing differs."""

import numpy as np
import pytest

pytest.importorskip("rclpy")
from quadtree_lss.lab.flight.flight import TICK, Flight
from quadtree_lss.lab.flight.fly import flown
from quadtree_lss.lab.flight.settings import flight_settings
from quadtree_lss.lab.live.flight import fly_live

SHORT = {"slant_range": 260.0, "speed": 26.0, "half": 8.0, "scatter": 3.0, "plan": {"survey": 3.0}}
SEED = 40049


@pytest.fixture(scope="module")
def live(tmp_path_factory):
    return fly_live(SEED, flight_settings(SHORT), tmp_path_factory.mktemp("live"))


def test_it_lands_safely_by_what_the_nodes_say(live):
    figures = live.flown.figures
    assert figures["outcome"] == "touchdown" and figures["safe"], figures
    assert any(heard.said.place is not None for heard in live.heard)
    assert any(d.what == "target" for d in live.flown.flight.pilot.decisions)


def test_with_the_same_answers_at_the_same_time_it_is_the_same_flight(live):
    """To the bit: nothing else came from the transport."""
    again, answers = Flight(SEED, flight_settings(SHORT)), list(live.heard)
    while not again.outcome:
        again.step()
        while answers and answers[0].tick <= round(again.time / TICK):
            again.hear(answers.pop(0).said)
    assert again.samples == live.flown.flight.samples
    assert again.pilot.decisions == live.flown.flight.pilot.decisions


def test_in_lock_step_it_comes_down_as_safely_and_as_cheaply(live):
    """Maps and passes fall on other moments, so the target may be another one as good as it."""
    alone = flown(SEED, flight_settings(SHORT))
    assert alone.figures["safe"] and live.flown.figures["safe"]
    for name in ("time", "propellant"):
        assert live.flown.figures[name] == pytest.approx(alone.figures[name], rel=0.05)
    apart = np.hypot(*(live.flown.flight.pilot.aim - alone.flight.pilot.aim)[:2])
    if apart < 0.3:  # the same target
        ends = [f.flight.lander.position for f in (live.flown, alone)]
        assert np.hypot(*(ends[0] - ends[1])[:2]) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["kill_lss@60+2", "kill_mapping@60+2"])
def test_a_node_that_is_killed_in_flight_comes_back_in_time(fault, tmp_path):
    found = fly_live(SEED, flight_settings({**SHORT, "faults": (fault,)}), tmp_path)
    assert found.flown.figures["safe"], found.flown.figures
