# SPDX-License-Identifier: Apache-2.0
"""The kind ``fly``: landings as flights of a study."""

import csv

import pytest

from quadtree_lss.lab.campaign.kinds import Case
from quadtree_lss.lab.campaign.landings import FLY, settings_of
from quadtree_lss.lab.campaign.store import Record
from quadtree_lss.lab.campaign.study import read_study
from quadtree_lss.lab.campaign.summary import _write_flights
from quadtree_lss.lab.flight.fly import flown
from quadtree_lss.lab.flight.settings import flight_settings

STUDY = """\
kind: fly
scenario: [none, perfect]
config: flight
seed: 30017
flights: 2
conditions: {slant_range: 260.0, speed: 26.0, rocks: 0.1}
parameters: {lss.margin: 0.7}
"""


@pytest.fixture
def study(tmp_path):
    (tmp_path / "study.yaml").write_text(STUDY)
    return read_study(tmp_path / "study.yaml")


def test_a_case_flies_as_the_function_does(study):
    case = study.case(1)
    assert (case.scenario, case.index) == ("perfect", 1)
    figures = FLY.fly(case)
    given = {"avoidance": "perfect", "slant_range": 260.0, "speed": 26.0, "rock_abundance": 0.1}
    alone = flown(case.seed, flight_settings(given)).figures
    for name in ("x", "y", "propellant", "safe", "time"):
        assert figures[name] == alone[name]
    assert figures["one"] == 1 and figures["unsafe"] + figures["aborted"] + figures["safe"] == 1


def test_every_quantity_is_a_figure_and_a_column(study, tmp_path):
    figures = FLY.fly(study.case(0))
    record = Record(0, 1, "none", {}, figures)
    _write_flights(tmp_path / "flights.csv", [record])
    with (tmp_path / "flights.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    assert float(row["error"]) == figures["error"]
    missing = {q.name for q in FLY.quantities} - figures.keys()
    # Only with the condition `judge: physics`.
    assert missing == {"physics_fails", "safe_but_fails"}


def test_conditions_and_parameters_reach_the_flight(study):
    case = study.case(0)
    more = {**case.conditions, "fault": "pose_gap@40+1", "survey": 3.0}
    settings = settings_of(Case(0, "fly", "package", 1, more, case.parameters))
    assert settings.plan.survey == 3.0 and settings.rock_abundance == 0.1
    assert settings.faults[0].kind == "pose_gap" and settings.config["lss.margin"] == 0.7
