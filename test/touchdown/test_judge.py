# SPDX-License-Identifier: Apache-2.0
"""Flights and studies that physics judges beside the contact; without the engine one line."""

import json
import sys

import pytest

from quadtree_lss.cli import main
from quadtree_lss.lab.campaign.kinds import Case
from quadtree_lss.lab.campaign.landings import FLY, settings_of
from quadtree_lss.lab.flight.fly import flown
from quadtree_lss.lab.flight.settings import FlightError, flight_settings
from quadtree_lss.onboard.errors import QuadtreeLssError

SHORT = {"avoidance": "perfect", "slant_range": 260.0, "speed": 26.0, "half": 8.0}


def test_a_flight_is_judged_on_legs_as_well():
    pytest.importorskip("mujoco")
    done = flown(3, flight_settings({**SHORT, "judge": "physics"}))
    found, bare = done.flight.landed, flown(3, flight_settings(SHORT)).figures
    assert found.outcome == done.figures["physics"] == "stands" and done.figures["safe"]
    assert {k: v for k, v in done.figures.items() if not k.startswith("physics")} == bare
    assert 0.0 < found.stroke < 0.25 and found.film[0, 3] == pytest.approx(bare["z"], abs=0.3)
    assert found.film[0, 1:3] == pytest.approx([bare["x"], bare["y"]])


def test_a_study_counts_those_that_do_not_stand():
    pytest.importorskip("mujoco")
    conditions = {"judge": "physics", "slant_range": 260.0, "speed": 26.0}
    case = Case(0, "fly", "none", 3, conditions=conditions)
    assert settings_of(case)[0].judge == "physics"
    figures = FLY.fly(case).figures
    assert figures["judged"] == 1 and figures["physics_fails"] in (0, 1)
    assert {q.name for q in FLY.quantities} - figures.keys() == {"propellant_ratio"}


def test_without_the_engine_nothing_is_flown_and_one_line_names_it(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(QuadtreeLssError, match="extra 'physics'"):
        flight_settings({"judge": "physics"})
    out = ["--out", str(tmp_path / "none"), "--no-page"]
    assert main(["fly", "--lockstep", "--avoidance", "none", "--physics", *out]) == 1
    said = capsys.readouterr().err.strip()
    assert "physics" in said and "\n" not in said


def test_a_judge_that_there_is_not():
    with pytest.raises(FlightError, match="contact, physics"):
        flight_settings({"judge": "luck"})


def test_the_command_says_what_became_of_it_on_legs(tmp_path, capsys):
    pytest.importorskip("mujoco")
    out = ["--out", str(tmp_path), "--no-page"]
    assert main(["fly", "--lockstep", "--avoidance", "none", "--seed", "3", "--physics", *out]) == 0
    figures = json.loads((tmp_path / "touchdown.json").read_text())
    assert f"on legs: {figures['physics']}," in capsys.readouterr().out
