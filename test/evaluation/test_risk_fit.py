# SPDX-License-Identifier: Apache-2.0
"""The fit of a risk model finds what made-up landings were made with; its command; its file."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import yaml

from quadtree_lss.cli import main
from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.lab.evaluation import risk_fit, risk_flights
from quadtree_lss.lab.evaluation.risk_families import FAMILIES
from quadtree_lss.lab.evaluation.risk_fit import (
    FEATURES,
    Term,
    fit,
    risk_model_text,
    risks,
    unfitted,
)
from quadtree_lss.lab.evaluation.risk_flights import fly, land
from quadtree_lss.onboard.config.parameter import ConfigError
from quadtree_lss.onboard.config.risk import LOCAL, Cause, model_warning, risk_model
from quadtree_lss.onboard.core.landing.risk import DENSITY_ENTRIES

SMALL = {
    "obstacle": (Term("rise", (0.4, 0.9, 1.5), begin=8.0), Term("noise", (-1.0, -0.5), 0)),
    "slope": (Term("tilt", (0.4, 1.0, 1.5), begin=8.0),),
    "hidden": (Term("seen", (-1.0, 1.0, 2.0), -1, begin=-3.0), Term("relief", (0.0, 0.6))),
}


@pytest.fixture
def small(monkeypatch):
    monkeypatch.setattr(risk_fit, "TERMS", SMALL)


@pytest.fixture
def made_up(small):
    """Places drawn evenly, and how often landings there fail by a small model."""
    model = unfitted()
    odds = {"rise": ((0.0, 4.0, 9.0),), "tilt": ((0.0, 5.0, 8.0),), "noise": ((0.0, -1.0),)}
    odds |= {"seen": ((0.0, -2.0, -4.0),), "relief": ((0.0, 1.5),)}
    causes = {
        name: Cause(constant, tuple(replace(c, odds=odds[c.feature]) for c in cause.curves))
        for (name, cause), constant in zip(model.causes.items(), (-6.0, -7.0, -1.0), strict=True)
    }
    model = replace(model, causes=causes)
    rng = np.random.default_rng(1)
    places = rng.uniform(-1.2, 1.6, (6000, len(FEATURES)))
    places[:, FEATURES.index("seen")] = rng.uniform(-1.5, 2.5, len(places))
    # Each place stands for landings that fail and some that do not.
    risk = risks(model, places)
    both = np.repeat(places, 2, axis=0)
    failed = np.tile([True, False], len(places))
    weight = np.stack([risk, 1.0 - risk], axis=1).ravel()
    return model, both, failed, weight


def test_a_model_is_found_again_from_what_it_made(made_up):
    model, places, failed, weight = made_up
    found = fit(places, failed, weight)
    expected, again = risks(model, places), risks(found, places)
    np.testing.assert_allclose(again, expected, atol=0.01)
    assert np.mean(np.abs(again - expected)) < 1e-3


def test_what_is_written_is_read_again(tmp_path):
    model = replace(risk_model(""), provenance={"families": {"whole": {"seeds": [1, 2]}}})
    file = tmp_path / "model.yaml"
    file.write_text(risk_model_text(model))
    assert risk_model(str(file)) == model


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        ("seen", [2.0, 1.0, 0.0], "do not ascend"),
        ("slope", None, "risk model"),
        ("slope tilt knots", [0.4, 0.5], "slope: tilt needs 1 or 3 rows of odds, one for each"),
        ("slope tilt odds", [[0.0] * 6, [1.0] * 6], "slope: tilt needs 1 or 3 rows of odds"),
        ("hidden seen odds", [[k] * 9 for k in range(3)], "hidden: seen needs 1 rows of odds"),
        ("slope tilt odds", [[0.0] * 5 + [float("nan")]], "slope: tilt has numbers that"),
        ("hidden constant", float("-inf"), "hidden: constant has numbers that are not finite"),
        ("hidden stones", {"knots": [0, 1], "odds": [[0, 1]]}, "hidden: stones is not known"),
    ],
)
def test_a_file_that_holds_no_model_is_one_clear_error(tmp_path, place, value, said):
    values = yaml.safe_load(risk_model_text(unfitted()))
    *keys, last = place.split()
    of = values
    for key in keys:
        of = of[key]
    of[last] = value
    file = tmp_path / "model.yaml"
    file.write_text(yaml.safe_dump(values, sort_keys=False))
    with pytest.raises(ConfigError, match=said) as caught:
        risk_model(str(file))
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ""),
        ({"vehicle.diameter": 0.6, "vehicle.clearance": 0.08, "domain.size": 16.0}, ""),
        ({"vehicle.diameter": 20.0}, "fitted for a vehicle of 0.5 to 8 m, not 20"),
        ({"vehicle.clearance": 0.05}, "a clearance of"),
        ({"domain.max_level": 5}, "cells of"),
        ({"lidar.range_noise": 0.4}, "a range noise of"),
        ({"domain.max_level": 5, "lss.assessment": "paper"}, ""),
    ],
)
def test_a_model_of_another_vehicle_or_map_is_told(changes, said):
    if "domain.size" in changes:
        changes = changes | {"lidar.range_noise": 0.02}
    found = model_warning(load_config(["morpheus"], changes))
    assert said in found and bool(said) == bool(found)


def test_the_command_flies_and_fits(tmp_path, capsys):
    out = tmp_path / "m.yaml"
    given = ["fit-risk", "--out", str(out), "--families", "few", "--seeds", "1-2"]
    with mock.patch.object(risk_flights, "MAX_LANDINGS", 100):
        assert main(given) == 0
    model = risk_model(str(out))
    assert model.provenance["families"]["few"]["seeds"] == [1, 2]
    assert "few" in capsys.readouterr().out
    told = model.provenance["fitted"]
    assert list(told) == ["diameter", "clearance", "max_slope_deg", "cell", "noise"]
    assert told["diameter"] == [3.7, 3.7]


def test_what_a_fit_asks_is_what_is_looked_up():
    """On a flight: the table of a model tells what its equations tell of what a fit is given."""
    config, model = load_config(["morpheus"]), risk_model("")
    mapped = fly(FAMILIES["drone"], 3, config)[-1]
    landings = land(mapped, model)
    asked = landings.features
    assert len(asked) > 1000 and 0.01 < landings.failed.mean() < 0.99

    def odds(found):
        found = np.clip(found, 1e-6, 1.0 - 1e-6)
        return np.log(found / (1.0 - found))

    off = odds(landings.risk) - odds(risks(model, asked))
    # The table has an entry for each step of what is seen, which is right in its middle.
    low, high = model.span("seen")
    half = np.zeros(asked.shape[1])
    half[LOCAL.index("seen")] = 0.5 * (high - low) / (DENSITY_ENTRIES - 1)
    step = odds(risks(model, asked + half)) - odds(risks(model, asked - half))
    assert np.mean(np.abs(off)) < 0.5 * np.mean(np.abs(step)) + 0.03
    assert abs(off.mean()) < 0.03
