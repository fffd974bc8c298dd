# SPDX-License-Identifier: Apache-2.0
"""The fit of a risk model finds what made-up landings were made with; its command; its file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import yaml

from quadtree_lss.cli import main
from quadtree_lss.lab.evaluation.metrics import scores
from quadtree_lss.lab.evaluation.risk_fit import (
    ABOUT,
    ABOUT_BINS,
    OWN,
    OWN_BINS,
    RISE,
    RISE_BINS,
    ROCKS,
    SLOPE,
    SLOPE_BINS,
    UNDULATION,
    counted,
    fit_curves,
    fit_tables,
    unfitted,
)
from quadtree_lss.lab.evaluation.risk_flights import Landings, fit_risk, fitted
from quadtree_lss.onboard.config.loading import load_config, shipped_names
from quadtree_lss.onboard.config.parameter import ConfigError
from quadtree_lss.onboard.config.risk import doubt, risk_model, risk_model_text
from quadtree_lss.onboard.config.settings import LssConfig, config_from_values
from quadtree_lss.onboard.core.landing.probability import RiskTable, interpolation_weights
from quadtree_lss.onboard.core.landing.touchdown import WorstContact


def test_landings_are_counted_in_the_nearest_bin():
    bins = np.linspace(0.0, 1.0, 3), np.linspace(0.0, 2.0, 2)
    counts = counted([0.1, 0.6, 7.0], [0.2, 1.9, -3.0], [True, False, True], bins)
    assert counts[0].tolist() == [[1, 0], [0, 1], [1, 0]]
    assert counts[1].tolist() == [[1, 0], [0, 0], [1, 0]]


def test_curves_are_found_again_from_made_up_counts():
    a = np.interp(RISE_BINS, [-0.15, 0.35], [-9.0, 11.0])
    b = np.interp(SLOPE_BINS, [-0.08, 0.1], [-8.0, 6.0])
    risk = 1.0 - 1.0 / ((1.0 + np.exp(a))[:, None] * (1.0 + np.exp(b)))
    rise_odds, slope_odds = fit_curves(np.stack([np.ones(risk.shape), risk]))
    found_a, found_b = (
        np.interp(RISE_BINS, RISE, rise_odds),
        np.interp(SLOPE_BINS, SLOPE, slope_odds),
    )
    found = 1.0 - 1.0 / ((1.0 + np.exp(found_a))[:, None] * (1.0 + np.exp(found_b)))
    likely = (risk > 0.002) & (risk < 0.998)
    assert np.abs(found / risk - 1.0)[likely].max() < 0.2
    assert np.abs(found - risk).max() < 0.02


def test_curves_ascend_where_chance_does_not():
    rng = np.random.default_rng(1)
    tried = rng.poisson(3.0, (RISE_BINS.size, SLOPE_BINS.size)).astype(float)
    counts = np.stack([tried, rng.binomial(tried.astype(int), 0.3)])
    for odds in fit_curves(counts):
        assert (np.diff(odds) >= 0.0).all()


def test_tables_are_found_again_and_ascend():
    """Of maps with rocks and slopes of all kinds, half of them by a noisier lidar."""
    rng, (own, about) = np.random.default_rng(3), (OWN_BINS[:, None], ABOUT_BINS)
    shares, counts = [], []
    for number in range(60):
        rock, slope = rng.uniform(ROCKS[0], ROCKS[-1]), rng.uniform(0.02, 0.09)
        noise, steep = float(number % 2), np.interp(slope, UNDULATION, (0.0, 1.0, 0.4))
        odds = np.clip(0.9 * own + 0.4 * about + 0.2 * rock, -9.0, None)
        odds = odds + noise * (0.5 + 0.1 * own) + steep * (0.3 * about - 0.2)
        risk = 1.0 / (1.0 + np.exp(-odds))
        counts.append([np.ones(risk.shape), risk])
        by_rock = interpolation_weights(np.array([rock]), ROCKS)[0]
        by_slope = interpolation_weights(np.array([slope]), UNDULATION)[0, 1:]
        shares.append([*by_rock, *by_slope, noise])
    found = fit_tables(np.array(shares), np.array(counts))
    tables, (first, second, noisy) = np.split(found, [len(ROCKS)])
    expected = 0.9 * np.array(OWN)[:, None] + 0.4 * np.array(ABOUT)
    expected = np.clip(expected + 0.2 * np.array(ROCKS)[:, None, None], -9.0, None)
    more = np.tile(0.5 + 0.1 * np.array(OWN)[:, None], len(ABOUT))
    steeper = np.tile(0.3 * np.array(ABOUT) - 0.2, (len(OWN), 1))
    inner = np.s_[..., 3:-1, :]  # where a failure is rare the penalty decides
    assert np.abs(tables - expected)[inner].max() < 0.5
    assert np.abs(noisy - more)[inner].max() < 0.3
    assert np.abs(first - steeper)[inner].max() < 0.3
    assert np.abs(second - 0.4 * steeper)[inner].max() < 0.3
    assert np.diff(tables, axis=1).min() > -0.05 and np.diff(tables, axis=2).min() > -0.05


def test_what_noise_and_slopes_add_is_nothing_where_no_landing_tells():
    counts = np.ones((1, 2, OWN_BINS.size, ABOUT_BINS.size))
    counts[:, 1] = 0.1
    level = np.array([[0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]])
    assert np.abs(fit_tables(level, counts)[len(ROCKS) :]).max() == 0.0


def test_a_model_of_made_up_landings_is_calibrated():
    """Rests on a map that is off by a few centimetres, and misplaced by nothing."""
    rng, lss = np.random.default_rng(2), LssConfig()
    config, shape = load_config(["morpheus"]), (150, 150)
    true = np.clip(rng.gamma(2.0, 0.1, shape), 0.0, 0.9)
    rise = true + rng.normal(0.0, 0.03, shape)
    slope = np.full(shape, 0.02)
    worst = WorstContact(rise.astype(np.float32), slope.astype(np.float32))
    judged = np.ones(shape, dtype=bool)
    failed = (true > lss.max_roughness).ravel()
    landings = Landings(worst, judged, judged, slope, failed, config.lidar.range_noise)
    model = fitted({"made up": [landings]}, config)
    noise = config.lidar.range_noise
    risk = RiskTable(model, config.lss, noise).risk(worst, judged, slope).ravel()
    for low, high in ((0.01, 0.1), (0.1, 0.5), (0.5, 0.95)):
        here = (risk >= low) & (risk < high)
        assert failed[here].mean() == pytest.approx(risk[here].mean(), rel=0.4)
    # Better than any threshold on the rise.
    brier = scores(risk, failed)[0]
    for limit in np.linspace(0.2, 0.4, 21):
        over = rise.ravel() > limit
        either = np.where(over, failed[over].mean(), failed[~over].mean())
        assert brier < scores(either, failed)[0]


def test_what_is_written_is_read_again(tmp_path):
    model = replace(unfitted(), provenance={"cases": {"default": {"seeds": [1, 2]}}})
    file = tmp_path / "model.yaml"
    file.write_text(risk_model_text(model))
    assert risk_model(str(file)) == model


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"odds": None}, "risk model"),
        ({"rise": [0.0, 0.0, 1.0], "rise_odds": [0.0, 1.0, 2.0]}, "rise do not ascend"),
        ({"slope_odds": [0.0]}, "slope has 12 knots and 1 values"),
        ({"about": [0.0, 1.0]}, "2 values in each row"),
        ({"own": "text"}, "risk model"),
        ({"noise": [0.08, 0.06]}, "noise do not ascend"),
        ({"noisy": [[0.0]]}, "own has 12 knots and 1 values"),
        ({"undulation": [0.0, 0.1]}, "undulation has 2 knots and 3 values"),
    ],
)
def test_a_file_that_holds_no_model_is_one_clear_error(tmp_path, change, said):
    values = yaml.safe_load(risk_model_text(unfitted())) | change
    file = tmp_path / "model.yaml"
    file.write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match=said) as caught:
        risk_model(str(file))
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)


def test_a_key_that_is_missing_or_a_file_is_told(tmp_path):
    values = yaml.safe_load(risk_model_text(unfitted()))
    del values["about"]
    file = tmp_path / "model.yaml"
    file.write_text(yaml.safe_dump(values))
    with pytest.raises(ConfigError, match="'about' is missing"):
        risk_model(str(file))
    with pytest.raises(ConfigError, match="cannot read"):
        risk_model(str(tmp_path / "none.yaml"))


def test_the_shipped_model_says_what_it_was_fitted_to():
    model = risk_model("")
    assert model.provenance["flights"] >= 20
    assert set(model.provenance["cases"]) >= {"default", "rocky", "steep", "told", "untold"}
    assert (np.diff(model.rise_odds) >= 0.0).all() and (np.diff(model.slope_odds) >= 0.0).all()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({}, ""),
        ({"vehicle.diameter": 4.5}, ""),
        ({"vehicle.diameter": 5.0}, "fitted for a vehicle of 3.7 m, not 5"),
        ({"vehicle.clearance": 0.2}, "a clearance of 0.3 m, not 0.2"),
        ({"domain.max_level": 7}, "cells of 0.25 m, not 0.5"),
        ({"lidar.range_noise": 0.1}, ""),
        ({"lidar.range_noise": 0.2}, "a range noise of 0.06 to 0.08 m, not 0.2"),
        ({"domain.max_level": 7, "lss.assessment": "paper", "lss.ranking": "score"}, ""),
    ],
)
def test_a_model_of_another_lander_or_map_is_told(changes, said):
    found = doubt(load_config(["morpheus"], changes))
    assert said in found and bool(said) == bool(found)


def test_a_fit_of_many_vehicles_goes_by_what_has_no_metres(tmp_path):
    """Two vehicles, one six times the other; and the lesser with the cells of the greater."""
    fitted = {"diameter": [0.6, 4.0], "clearance": [0.1, 0.1], "cell": [0.1, 0.1]}
    origin = {"fitted": {**fitted, "noise": [0.2, 0.2], "max_slope_deg": [10.0, 10.0]}}
    path = tmp_path / "many.yaml"
    path.write_text(risk_model_text(replace(risk_model(""), provenance=origin)))
    for size in (0.6, 3.6):
        lander = {"vehicle.diameter": size, "vehicle.clearance": 0.1 * size}
        small = {"domain.size": 25.6 * size, "domain.max_level": 8, "lss.risk_model": str(path)}
        noise = {"lidar.range_noise": 0.02 * size}
        assert doubt(config_from_values({**lander, **small, **noise})) == ""
    wide = {"vehicle.diameter": 0.6, "vehicle.clearance": 0.06, "lidar.range_noise": 0.012}
    assert "cells of 0.06 m, not 0.36" in doubt(config_from_values({**small, **wide}))


def test_config_check_tells_of_a_model_of_another_lander(tmp_path, capsys):
    (tmp_path / "big.yaml").write_text("/**: {ros__parameters: {lss: {vehicle_diameter: 9.0}}}")
    assert main(["config", "check", str(tmp_path / "big.yaml")]) == 0
    told = capsys.readouterr()
    assert "good" in told.out and "3.7 m, not 9" in told.err


def test_the_model_is_no_configuration():
    assert "flash_lidar" not in shipped_names()


@pytest.mark.parametrize(
    ("options", "said"),
    [(["--cases", "moon"], "there is no case 'moon'"), (["--seeds", "1,2"], "too few for 9 cases")],
)
def test_a_fit_that_cannot_be_is_told(tmp_path, capsys, options, said):
    assert main(["fit-risk", "--out", str(tmp_path / "m.yaml"), *options]) == 1
    assert said in capsys.readouterr().err
    assert not (tmp_path / "m.yaml").exists()


@pytest.mark.slow
def test_one_flight_is_fitted(tmp_path):
    model = fit_risk(load_config(["morpheus"]), [20000], ["default"])
    assert model.provenance["cases"]["default"]["points"] > 50_000
    assert model.provenance["brier"] < 0.05
