# SPDX-License-Identifier: Apache-2.0
"""Whole flights in lock-step, from 250 m of range to save time."""

import json

import numpy as np
import pytest
from report.pages import Page, accessible, in_a_browser, sheets

from quadtree_lss.cli import main
from quadtree_lss.lab.flight.flight_page import write_flight
from quadtree_lss.lab.flight.fly import flown
from quadtree_lss.lab.flight.settings import FlightError, flight_settings
from quadtree_lss.onboard.core.landing.target import State

pytestmark = pytest.mark.xdist_group("fly")  # its flight is made once

SHORT = {"slant_range": 260.0, "speed": 26.0, "half": 8.0, "scatter": 3.0, "plan": {"survey": 3.0}}
SEED = 40049


def fly(**more):
    return flown(SEED, flight_settings({**SHORT, **more})).figures


@pytest.fixture(scope="module")
def short():
    faults = ("pose_gap@60+1",)
    return flown(SEED, flight_settings({**SHORT, "faults": faults}), record=True)


def test_it_lands_safely_on_the_target(short):
    figures = short.figures
    assert figures["outcome"] == "touchdown" and figures["safe"], figures
    last, x, y = short.last, figures["x"], figures["y"]
    assert figures["error"] < 0.5 and figures["map_said"] in ("safe", "partly_unobserved", "unsafe")
    # Where it stands at last, at the limit of what is allowed, is no longer its choice.
    assert last.risk[abs(last.y - y).argmin(), abs(last.x - x).argmin()] < 0.01
    assert last.selected.id
    chosen = [d for d in short.flight.pilot.decisions if d.what in ("target", "divert")]
    assert any(d.what == "target" for d in chosen)
    assert all(d.height >= short.flight.settings.rules.gate for d in chosen)


@pytest.mark.slow
def test_the_same_seed_is_the_same_flight(short):
    assert fly(faults=("pose_gap@60+1",)) == short.figures


@pytest.mark.slow
def test_without_avoidance_it_lands_on_the_planned_point_and_by_perfect_knowledge_safely():
    figures = fly(avoidance="none")
    assert figures["outcome"] == "touchdown" and figures["soft"]
    assert figures["from_planned"] < 0.5 and figures["map_said"] == "nothing"
    assert fly(avoidance="perfect", rock_abundance=0.1)["safe"]


@pytest.mark.slow
def test_a_target_outlives_the_node_that_chose_it():
    flight = flown(SEED, flight_settings({**SHORT, "faults": ("kill_lss@60+2",)})).flight
    done = [decision.what for decision in flight.pilot.decisions]
    assert "target" in done and "lost" not in done, done


@pytest.mark.slow
def test_land_now_is_flown_to_the_ground():
    done = flown(SEED, flight_settings({**SHORT, "faults": ("land_now@60",)}))
    assert done.last.selected.state is State.NOW and done.figures["outcome"] == "touchdown"
    away = np.hypot(*(done.last.selected.position - done.flight.lander.position)[:2])
    assert away < 1.0 and done.figures["map_said"] == "safe"


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault", ["kill_lss@60", "kill_mapping@40", "forget_mapping@40", "keep_out@22", "keep_out@12"]
)
def test_no_fault_ends_on_ground_that_was_known_to_be_unsafe(fault):
    """And a target outlives a node that comes back with its checkpoint, but not a map that is
    forgotten."""
    done = flown(SEED, flight_settings({**SHORT, "faults": (fault,)}))
    assert done.figures["safe"] or done.figures["outcome"] == "aborted", done.figures
    assert done.figures["map_said"] != "unsafe"
    if "mapping" in fault:
        lost = "lost" in [decision.what for decision in done.flight.pilot.decisions]
        assert lost == fault.startswith("forget")


WRONG_TIMES = ("nan", "inf", "-1", "60+-3", "60+1e99", "60+nan", "60+0")


@pytest.mark.parametrize(
    ("values", "word"),
    [
        (
            {"avoidance": "luck"},
            "unknown avoidance 'luck'; there are package, paper, none, perfect",
        ),
        ({"speeed": 3.0}, "speeed"),
        ({"faults": ("meteor@50",)}, "meteor"),
        ({"faults": ("pose_gap",)}, "KIND@HEIGHT"),
        ({"vehicle": {"wings": 2}}, "vehicle"),
        ({"half": -3.0}, "half must be between 2 and 10000, not -3"),
        ({"outliers": "many"}, "outliers must be between 0 and 1, not many"),
        ({"plan": {"survey": 0.0}}, "survey must be"),
        *(({"faults": (f"kill_mapping@{when}",)}, "from 0 to") for when in WRONG_TIMES),
    ],
)
def test_wrong_settings_are_one_clear_error(values, word):
    with pytest.raises(FlightError, match=word):
        flight_settings(values)


@pytest.mark.slow
def test_the_command_writes_figures_and_page(tmp_path, capsys, monkeypatch):
    out = tmp_path / "flight"
    code = main(["fly", "--lockstep", "--seed", "3", "--avoidance", "none", "--out", str(out)])
    assert code == 0 and "touchdown" in capsys.readouterr().out
    figures = json.loads((out / "touchdown.json").read_text())
    assert {"safe", "x", "y", "error", "propellant", "diverts"} <= figures.keys()
    page = (out / "flight.html").read_text()
    assert "seed 3" in page and "data:image/png;base64" in page
    assert "the flight made none" in page and (out / "cells.npz").exists()
    assert "Content-Security-Policy" in page and 'class="verdict' in page  # as all pages are
    assert main(["fly", "--lockstep", "--fault", "x@1", "--out", str(out)]) == 1
    monkeypatch.setattr("quadtree_lss.lab.flight.fly.flown", None)  # nothing is flown for nothing
    assert main(["fly", "--lockstep", "--out", str(out / "flight.csv" / "none")]) == 1
    assert "cannot be written" in capsys.readouterr().err


@pytest.fixture(scope="module")
def text(short, tmp_path_factory):
    out = tmp_path_factory.mktemp("flight") / "out"
    write_flight(out, short)
    return (out / "flight.html").read_text()


def test_the_page_is_that_of_the_map_with_the_flight(short, text):
    """And the folder is one of results."""
    found = Page(text)
    flight, samples = found.data["flight"], short.flight.samples
    np.testing.assert_allclose(found.column(flight["z"]), [s.z for s in samples], atol=1e-4)
    assert [d[2] for d in flight["decisions"]] == [d.what for d in short.flight.pilot.decisions]
    ((kind, begin, end),) = flight["faults"]
    assert kind == "pose_gap" and end - begin == pytest.approx(1.0)
    assert flight["areas"] and len(flight["areas"]) == len(short.flight.areas)
    layers = {layer["name"]: found.column(layer["values"]) for layer in found.data["layers"]}
    data = found.data["grid"]
    x, y = (data[f"{axis}min"] + data["spacing"] * np.arange(data[f"n{axis}"]) for axis in "xy")
    true = short.flight.ground.terrain.elevation_at(*np.meshgrid(x, y)).ravel()
    np.testing.assert_allclose(layers["truth"], true, atol=1e-3)
    at_x, at_y, _ = short.flight.lander.position
    here = np.hypot(*np.meshgrid(x - at_x, y - at_y)).argmin()
    assert layers["stands"][here] == 0  # a safe touchdown
    assert len(text) < 5e6 and 'class="verdict good"' in text


@in_a_browser
@pytest.mark.slow
def test_its_page_can_be_used_by_all_and_prints_on_two_sheets(text, in_browser):
    assert accessible(in_browser, text) and 1 <= sheets(in_browser, text) <= 2
