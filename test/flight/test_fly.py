# SPDX-License-Identifier: Apache-2.0
"""Whole flights in lock-step, from 250 m of range to save time."""

import json

import numpy as np
import pytest

from quadtree_lss.cli import main
from quadtree_lss.lab.flight.fly import flown, fly
from quadtree_lss.lab.flight.ground import Ground
from quadtree_lss.lab.flight.settings import Fault, FlightError, flight_settings
from quadtree_lss.onboard.core.landing.target import State

SHORT = {"slant_range": 260.0, "speed": 26.0, "half": 8.0, "scatter": 3.0, "plan": {"survey": 3.0}}
SEED = 40049


@pytest.fixture(scope="module")
def short():
    return flown(SEED, flight_settings(SHORT))


def test_it_lands_safely_on_the_target(short):
    figures = short.figures
    assert figures["outcome"] == "touchdown" and figures["safe"], figures
    assert figures["error"] < 0.5 and figures["map_said"] in ("safe", "margin")
    assert short.last.selected.id
    assert any(d.what == "target" for d in short.flight.pilot.decisions)


def test_no_decision_is_taken_too_low(short):
    rules = short.flight.settings.rules
    for decision in short.flight.pilot.decisions:
        if decision.what in ("target", "divert"):
            assert decision.height >= rules.gate


@pytest.mark.slow
def test_the_same_seed_is_the_same_flight(short):
    assert fly(SEED, SHORT) == short.figures


def test_without_avoidance_it_lands_on_the_planned_point():
    figures = fly(SEED, {**SHORT, "avoidance": "none"})
    assert figures["outcome"] == "touchdown" and figures["soft"]
    assert figures["from_planned"] < 0.5 and figures["map_said"] == "nothing"


def test_perfect_knowledge_lands_safely():
    figures = fly(SEED, {**SHORT, "avoidance": "perfect", "rock_abundance": 0.1})
    assert figures["safe"]


def test_a_target_outlives_the_node_that_chose_it():
    flight = flown(SEED, flight_settings({**SHORT, "faults": ("kill_lss@60+2",)})).flight
    done = [decision.what for decision in flight.pilot.decisions]
    assert "target" in done and "lost" not in done, done


def test_land_now_is_flown_to_the_ground():
    done = flown(SEED, flight_settings({**SHORT, "faults": ("land_now@60",)}))
    assert done.last.selected.state is State.NOW and done.figures["outcome"] == "touchdown"
    away = np.hypot(*(done.last.selected.position - done.flight.lander.position)[:2])
    assert away < 1.0 and done.figures["map_said"] == "safe"


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault", ["kill_lss@60", "kill_mapping@60", "forget_mapping@40", "keep_out@22", "keep_out@12"]
)
def test_no_fault_ends_on_ground_that_was_known_to_be_unsafe(fault):
    figures = fly(SEED, {**SHORT, "faults": (fault,)})
    assert figures["safe"] or figures["outcome"] == "aborted", figures
    assert figures["map_said"] != "unsafe"


def test_rocks_are_strewn_on_a_terrain_if_asked_for(tmp_path):
    posts = np.linspace(-60.0, 60.0, 61)
    np.savez(tmp_path / "flat.npz", x=posts, y=posts, elevation=np.zeros((61, 61)))
    given = {"terrain": str(tmp_path / "flat.npz"), "avoidance": "none"}
    bare, rocky = (
        Ground.of(flight_settings({**given, **more}), np.random.default_rng(1))
        for more in ({}, {"rock_abundance": 0.2})
    )
    assert not bare.terrain.elevation.any() and bare.safe[2].min() > 0.0
    assert rocky.terrain.elevation.max() > 0.3 and (rocky.safe[2] == 0.0).any()


WRONG_TIMES = ("nan", "inf", "-1", "60+-3", "60+1e99", "60+nan", "60+0")


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"avoidance": "luck"}, "avoidance"),
        ({"speeed": 3.0}, "speeed"),
        ({"faults": ("meteor@50",)}, "meteor"),
        ({"faults": ("pose_gap",)}, "KIND@HEIGHT"),
        ({"vehicle": {"wings": 2}}, "vehicle"),
        *(({"faults": (f"kill_mapping@{when}",)}, "from 0 to") for when in WRONG_TIMES),
    ],
)
def test_wrong_settings_are_one_clear_error(values, word):
    with pytest.raises(FlightError, match=word):
        flight_settings(values)


def test_a_fault_is_read_from_text():
    assert Fault.read("pose_gap@50+1.5") == Fault("pose_gap", 50.0, 1.5)
    assert Fault.read("keep_out@12") == Fault("keep_out", 12.0, 3.0)


def test_the_command_writes_figures_and_page(tmp_path, capsys):
    out = tmp_path / "flight"
    code = main(["fly", "--lockstep", "--seed", "3", "--avoidance", "none", "--out", str(out)])
    assert code == 0 and "touchdown" in capsys.readouterr().out
    figures = json.loads((out / "touchdown.json").read_text())
    assert {"safe", "x", "y", "error", "propellant", "diverts"} <= figures.keys()
    page = (out / "flight.html").read_text()
    assert "seed 3" in page and "data:image/png;base64" in page
    assert "Content-Security-Policy" in page and 'class="verdict' in page  # as all pages are
    assert main(["fly", "--lockstep", "--fault", "x@1", "--out", str(out)]) == 1
