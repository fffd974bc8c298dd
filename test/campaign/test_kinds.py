# SPDX-License-Identifier: Apache-2.0
"""Kinds of flights of a study: mapped in memory, to the same bits as through a bag; landings."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.lab.campaign import flights
from quadtree_lss.lab.campaign.flights import FLY, figures, fly_in_memory, lander_of
from quadtree_lss.lab.campaign.study import read_study
from quadtree_lss.lab.evaluation.evaluate import evaluate, score
from quadtree_lss.lab.evaluation.results import load_results, load_truth
from quadtree_lss.lab.flight.fly import fly_lockstep
from quadtree_lss.lab.flight.settings import flight_settings
from quadtree_lss.lab.simulation.simulate import simulate

CASES = {
    "morpheus": {"duration": 3.0, "outliers": 0.01, "dropouts": 0.02, "navigation_error": 2.0},
    "parabola": {"duration": 3.0, "range_noise": 0.1},
    "descent": {"duration": 2.0, "flights": 2, "rocks": 0.1},
}


def _same(one, two, where=""):
    assert type(one) is type(two), where
    if dataclasses.is_dataclass(one):
        for field in dataclasses.fields(one):
            if field.name not in ("covariance_range",):
                _same(getattr(one, field.name), getattr(two, field.name), f"{where}.{field.name}")
    elif isinstance(one, dict):
        for name in one | two:
            _same(one[name], two[name], f"{where}.{name}")
    elif isinstance(one, np.ndarray):
        np.testing.assert_array_equal(one, two, err_msg=where)
        assert one.dtype == two.dtype, where
    else:
        assert one == two, where


@pytest.mark.quick("morpheus")
@pytest.mark.parametrize("scenario", list(CASES))
def test_the_same_bits_as_through_a_bag(scenario, tmp_path):
    named = [scenario] if scenario != "descent" else []
    config = load_config(named, {"vehicle.max_slope_deg": 8.0})
    options = CASES[scenario]
    simulate(scenario, tmp_path / "bag", seed=30001, lander=lander_of(config), **options)
    replay(tmp_path / "bag", tmp_path / "results", config, report=False)
    results, truth = fly_in_memory(scenario, 30001, config, options)
    by_bag = load_results(tmp_path / "results"), load_truth(tmp_path / "truth.npz")
    for name in ("map", "grid", "positions"):
        _same(getattr(results, name), getattr(by_bag[0], name), name)
    _same(results.timing["stamp_ns"], by_bag[0].timing["stamp_ns"])
    _same(truth, by_bag[1])
    assert truth.lander.max_slope_deg == 8.0
    assert figures(score(results, truth), results, truth) == figures(score(*by_bag), *by_bag)
    told = evaluate(tmp_path / "results", tmp_path / "truth.npz", page=False)
    assert repr(told.detection) == repr(score(results, truth).detection)  # NaN is NaN


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


def test_a_case_flies_as_the_function_does(study, monkeypatch):
    case = study.case(1)
    assert (case.scenario, case.index) == ("perfect", 1)
    figures = FLY.fly(case)
    given = {"avoidance": "perfect", "slant_range": 260.0, "speed": 26.0, "rocks": 0.1}
    alone = fly_lockstep(case.seed, flight_settings(given)).figures
    for name in ("x", "y", "propellant", "safe", "time"):
        assert figures[name] == alone[name]
    assert figures["one"] == 1 and figures["unsafe"] + figures["aborted"] + figures["safe"] == 1
    gone = SimpleNamespace(figures=alone | {"outcome": "aborted", "safe": False})
    monkeypatch.setattr(flights.lockstep, "fly_lockstep", lambda *_: gone)
    assert FLY.fly(case)["from_planned"] is None  # of a touchdown that there was not
