# SPDX-License-Identifier: Apache-2.0
"""Probability of a safe touchdown: the fit looked up, dispersion, ranking, and what is left."""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
import yaml
from core.builders import configured, mapped
from numpy.typing import NDArray

from quadtree_lss.onboard.config.risk import RiskModel, risk_model, risk_model_text
from quadtree_lss.onboard.config.settings import ConfigError, LssConfig, VehicleConfig
from quadtree_lss.onboard.core.landing import hazards, score
from quadtree_lss.onboard.core.landing.grid import TIE, probable_first
from quadtree_lss.onboard.core.landing.probability import (
    Dispersion,
    Remainder,
    RiskTable,
    aimed,
    heading_word,
    limits,
    shown,
)
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.landing.touchdown import Limits, TouchdownCheck, WorstContact

Array = NDArray[np.float64]

MODEL = RiskModel(
    rise=(-0.1, 0.0, 0.2),
    rise_odds=(-8.0, -1.0, 5.0),
    slope=(-0.05, 0.0, 0.05),
    slope_odds=(-7.0, 0.0, 4.0),
    own=(-10.0, 0.0, 6.0),
    about=(0.0, 2.0, 6.0),
    rocks=(-4.0, 1.0),
    odds=(
        ((-10.0, -9.5, -8.0), (-1.0, -0.5, -0.2), (5.0, 6.0, 6.0)),
        ((-10.0, -9.0, -4.0), (0.0, 0.5, 1.0), (6.0, 6.0, 6.0)),
    ),
    undulation=(0.02, 0.05, 0.06),
    undulating=(
        ((0.5, 0.2, 0.0), (-0.4, 0.3, 0.0), (0.0, 0.0, 0.3)),
        ((-0.5, 0.2, 1.0), (0.8, 0.0, 0.6), (0.0, 0.5, 0.0)),
    ),
    noise=(0.05, 0.08),
    noisy=((0.0, 0.5, 1.0), (0.4, 0.0, -0.6), (-0.5, 0.0, 0.5)),
)


def block(x: Array, y: Array) -> Array:
    """One of 1.4 m, 0.6 m high, on level ground."""
    return 0.6 * ((np.abs(x - 16.0) < 0.7) & (np.abs(y - 16.0) < 0.7))


def log_odds(p: float) -> float:
    return float(np.log(p / (1.0 - p)))


def by_hand(
    rise: Array,
    slope: Array,
    judged: NDArray[np.bool_],
    ground: Array,
    lss: LssConfig,
    noise: float,
) -> Array:
    """The equations of ``RiskModel``, point by point."""
    out = np.ones(rise.shape)
    own = np.full(rise.shape, MODEL.own[0])
    steep = np.tan(np.radians(lss.max_slope_deg))
    for place in zip(*np.nonzero(judged), strict=True):
        a = np.interp(rise[place] - lss.max_roughness, MODEL.rise, MODEL.rise_odds)
        b = np.interp(slope[place] - steep, MODEL.slope, MODEL.slope_odds)
        p = 1.0 - 1.0 / ((1.0 + np.exp(a)) * (1.0 + np.exp(b)))
        own[place] = np.clip(log_odds(p), MODEL.own[0], MODEL.own[-1])
    padded = np.pad(own, 1, constant_values=-np.inf)
    level = rise[judged & (slope <= steep)]
    much, some = ((level > lss.max_roughness - less).mean() for less in (0.0, 0.12))
    rocks = np.log(much * (much / some) ** 3 + 3e-5)
    share = np.clip((rocks - MODEL.rocks[0]) / (MODEL.rocks[1] - MODEL.rocks[0]), 0.0, 1.0)
    few, many = np.array(MODEL.odds)
    more = min(max((noise - 0.05) / 0.03, 0.0), 1.0)
    table = (1.0 - share) * few + share * many + more * np.array(MODEL.noisy)
    steepness = ground[judged & (slope <= steep)].mean()
    between = [np.zeros((3, 3)), *np.array(MODEL.undulating)]
    knot = max(int(np.searchsorted(MODEL.undulation, steepness)), 1)
    low, high = (MODEL.undulation + (np.inf,))[knot - 1 : knot + 1]
    part = max(steepness - low, 0.0) / (high - low)
    table += (1.0 - part) * between[knot - 1] + (part * between[knot] if part else 0.0)
    for i, j in zip(*np.nonzero(judged), strict=True):
        four = padded[i, j + 1], padded[i + 2, j + 1], padded[i + 1, j], padded[i + 1, j + 2]
        d = max(max(four) - own[i, j], 0.0)
        rows = [np.interp(d, MODEL.about, row) for row in table]
        out[i, j] = 1.0 / (1.0 + np.exp(-np.interp(own[i, j], MODEL.own, rows)))
    return out


@pytest.mark.parametrize(
    ("most", "noise", "steepest"),
    [(0.302, 0.03, 0.03), (0.45, 0.06, 0.08), (0.6, 0.2, 0.108), (0.45, 0.06, 0.3)],
)
def test_the_fit_is_looked_up_as_its_equations_say(most, noise, steepest):
    """On ground that is rocky or undulates, and less so, by lidars that are noisy and less so."""
    lss = LssConfig()
    rng = np.random.default_rng(3)
    shape = (40, 40)
    rise = rng.uniform(0.1, most, shape).astype(np.float32)
    slope = rng.uniform(0.05, 0.3, shape).astype(np.float32)
    judged = rng.random(shape) < 0.8
    ground = np.where(judged, rng.uniform(0.0, steepest, shape), np.nan)
    found = RiskTable(MODEL, lss, noise).risk(WorstContact(rise, slope), judged, ground)
    expected = by_hand(rise.astype(float), slope.astype(float), judged, ground, lss, noise)
    odds, wanted = (np.log(p[judged] / (1.0 - p[judged])) for p in (found, expected))
    np.testing.assert_allclose(odds, wanted, atol=0.1)
    assert (found[~judged] == 1.0).all()


def test_aims_are_means_over_the_touchdowns_drawn_from_the_dispersion():
    rng = np.random.default_rng(4)
    risk = (rng.random((41, 41)) < 0.3).astype(float)
    spread = Dispersion(0.8, 0.3)
    found = aimed(risk, 0.25, spread)
    for row, column in ((20, 20), (1, 39), (8, 30)):
        steps = rng.normal(0.0, 1.0, (200_000, 2)) * (spread.y / 0.25, spread.x / 0.25)
        i, j = np.rint(steps + (row, column)).astype(int).T
        inside = (i >= 0) & (i < 41) & (j >= 0) & (j < 41)
        fails = np.where(inside, risk[np.clip(i, 0, 40), np.clip(j, 0, 40)], 1.0)
        assert found[row, column] == pytest.approx(fails.mean(), abs=0.01)


def test_without_dispersion_the_aim_is_the_place():
    risk = np.random.default_rng(5).random((9, 9))
    np.testing.assert_allclose(aimed(risk, 0.25, Dispersion(0.0, 0.0)), risk, atol=1e-15)


def test_the_worst_contact_does_not_depend_on_the_limits():
    config = configured(domain={"size": 32.0})
    cells = mapped(config, block, density=60.0).snapshot()
    raster = rasterise(cells, config.lss)
    inside = np.zeros((65, 65), dtype=bool)
    inside[8:-8, 8:-8] = True
    wide = TouchdownCheck(config.lss, Limits((0.0, 9.0), (0.0, 9.0))).worst(raster, inside)
    narrow = TouchdownCheck(config.lss, Limits((0.2, 0.9), (0.1, 0.2))).worst(raster, inside)
    clipped = np.maximum(wide.rise, 0.2)
    compared = inside & (clipped < 0.9) & (wide.slope < 0.2)
    np.testing.assert_allclose(narrow.rise[compared], clipped[compared], atol=2e-4)
    known = inside & (wide.slope < 0.2)
    np.testing.assert_allclose(narrow.slope[known], np.maximum(wide.slope, 0.1)[known], atol=1e-5)
    assert (compared & (clipped > 0.2)).any()


def probable(**lss: object) -> LandingSiteSelector:
    given = {"assessment": "probability", "ranking": "probability", **lss}
    return LandingSiteSelector(configured(domain={"size": 32.0}, lss=given))


@pytest.fixture(scope="module")
def beside_a_rock():
    config = configured(domain={"size": 32.0})
    return mapped(config, block, density=60.0).snapshot()


def test_a_rock_is_bad_ground_and_what_is_far_from_it_is_safe(beside_a_rock):
    found = probable(dispersion=0.0).assess(beside_a_rock)
    at_rock = np.hypot(found.x[None] - 16.0, found.y[:, None] - 16.0)
    on_edge = np.minimum.reduce(
        np.broadcast_arrays(
            found.x[None], found.y[:, None], 32.0 - found.x[None], 32.0 - found.y[:, None]
        )
    )
    assert found.risk[at_rock < 1.5].min() > 0.5
    far = (at_rock > 4.0) & (on_edge > 2.5)
    assert found.risk[far].max() < 0.005
    assert found.safe[far].all()
    assert (found.hazard[at_rock < 1.5] & hazards.TOUCHDOWN > 0).all()
    assert (found.hazard[at_rock < 1.0] & hazards.UNCERTAIN == 0).all()
    np.testing.assert_allclose(found.probability, 1.0 - found.risk)


def test_sites_are_ranked_by_the_probability_of_the_aim(beside_a_rock):
    found = probable(dispersion=1.0).assess(beside_a_rock)
    ranked = found.sites.probability
    assert len(ranked) == 5
    assert (np.diff(ranked) <= 0.0).all()
    assert ranked[0] == found.probability[found.safe].max()
    assert (np.hypot(*(found.sites.position[:1, :2] - 16.0).T) > 5.0).all()


def test_beyond_the_edge_and_unseen_nothing_is_safe(beside_a_rock):
    observed = beside_a_rock.observed.copy()
    observed[:, :16] = False
    found = probable(dispersion=0.5).assess(replace(beside_a_rock, observed=observed))
    assert (found.risk[:, found.x < 8.0] == 1.0).all()
    assert (found.probability[:, found.x < 6.0] < 1e-3).all()
    assert (found.probability[[0, -1]] < 0.51).all()


def test_guidance_goes_before_the_configuration(beside_a_rock):
    selector = probable(dispersion=3.0)
    own = selector.assess(beside_a_rock).probability
    theirs = selector.assess(beside_a_rock, dispersion=[0.2, 0.1]).probability
    np.testing.assert_array_equal(
        theirs, 1.0 - aimed(selector.assess(beside_a_rock).risk, 0.5, Dispersion(0.2, 0.1))
    )
    assert theirs.max() > own.max()


@pytest.mark.parametrize("rule", ["probability", "touchdown"])
def test_a_heading_counts_for_limits_and_not_for_the_risk_fitted_to_the_worst(beside_a_rock, rule):
    ranking, heard = "probability" if rule == "probability" else "score", []
    selector, worst = probable(assessment=rule, ranking=ranking), TouchdownCheck.worst

    def hear(check, raster, candidates, heading=None):
        heard.append(heading)
        return worst(check, raster, candidates, heading)

    with mock.patch.object(TouchdownCheck, "worst", hear):
        one = selector.assess(beside_a_rock, dispersion=[0.0, 0.0, 0.3])
    assert heard == [None if rule == "probability" else 0.3]
    every = selector.assess(beside_a_rock, dispersion=[0.0, 0.0])
    np.testing.assert_array_equal(one.risk, every.risk)


@pytest.mark.parametrize("given", [[1.0], [1.0, -1.0], [np.nan, 1.0], [1e9, 1.0], [1, 1, 0, 0]])
def test_what_is_no_dispersion_is_refused(beside_a_rock, given):
    with pytest.raises(ValueError, match="dispersion needs two deviations"):
        probable().assess(beside_a_rock, dispersion=given)


def test_reasons_say_what_is_left(beside_a_rock):
    found = probable(dispersion=1.5).assess(beside_a_rock, target=[20.0, 16.0])
    place = np.hypot(*(found.sites.position[:, :2] - 16.0).T)
    assert all(" safe: the remaining risk is " in reason for reason in found.sites.reasons)
    nearest = found.sites.reasons[int(np.argmin(place))]
    assert "an obstacle" in nearest or "too steep" in nearest


def test_words():
    assert shown(0.9917) == "99.2 %"
    assert shown(0.99997) == "99.99 %"
    assert shown(float("nan")) == "-"
    risk = "probability 99.2 %: the remaining risk is"
    assert Remainder(0.9917, 3.14, 0.0, "obstacle").words() == f"{risk} an obstacle 3.1 m east"
    assert Remainder(0.9917, 0.0, 0.0, "slope").words() == f"{risk} too steep a slope here"
    assert (
        Remainder(0.99997, 0.0, 0.0, "slope").words() == "probability 99.99 %"
    )  # not worth a word
    assert [heading_word(np.radians(a)) for a in (0, 44, 91, 180, -91)] == [
        "east",
        "north-east",
        "north",
        "west",
        "south",
    ]


def test_what_is_more_probable_comes_first_whatever_its_score():
    """Scores of any size and sign, -1 among them, decide between equals alone."""
    rng = np.random.default_rng(8)
    unsafe = rng.choice([0.0, 0.004, 0.004 + 1.01 * TIE, 0.083, 1.0], 4000)
    score = np.append(-1.0, rng.choice([-1.0, 1.0], 3999) * 10.0 ** rng.uniform(-3.0, 4.0, 3999))
    order = np.argsort(probable_first(unsafe, score))
    assert (np.diff(unsafe[order]) >= 0.0).all()
    same = np.diff(unsafe[order]) == 0.0
    assert same.sum() > 3900 and (np.diff(score[order])[same] >= 0.0).all()


def test_limits_cover_the_model_and_the_touchdown_limits():
    found = limits(MODEL, LssConfig(vehicle=VehicleConfig(clearance=0.9, max_slope_deg=30.0)))
    assert found.rise == (pytest.approx(0.75), pytest.approx(1.1))
    assert found.slope[0] == pytest.approx(np.tan(np.radians(27.0)))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (("rise: [-0.1, 0, 0.2]\n", ""), "'rise' is missing"),
        (("rocks: [-4, 1]", "rocks: [-4]"), "rocks has 1 knots and odds 2 tables"),
        (("own: [", "own: ["), None),
    ],
)
def test_a_file_that_is_no_model_is_refused(tmp_path, change, said):
    path = tmp_path / "model.yaml"
    text = risk_model_text(MODEL)
    assert change[0] in text
    path.write_text(text.replace(*change))
    if said is None:
        assert risk_model(str(path)).own == MODEL.own
        return
    with pytest.raises(ConfigError, match=said):
        risk_model(str(path))


def test_files_of_former_versions_are_read(tmp_path):
    """The first had one table for all ground; then there were several, with nothing added."""
    path, values = tmp_path / "model.yaml", yaml.safe_load(risk_model_text(MODEL))
    for newer in ("undulation", "undulating", "noise", "noisy"):
        del values[newer]
    nothing, at = ((0.0,) * 3,) * 3, (0.0, 1.0)
    plain = replace(MODEL, undulation=at, undulating=(nothing,), noise=at, noisy=nothing)
    path.write_text(yaml.safe_dump(values))
    assert risk_model(str(path)) == plain
    path = tmp_path / "first.yaml"
    del values["rocks"]
    path.write_text(yaml.safe_dump(values | {"odds": values["odds"][0]}))
    assert risk_model(str(path)) == replace(plain, rocks=(0.0,), odds=MODEL.odds[:1])


def test_the_shipped_model_grows_with_what_is_over_the_limits():
    model = risk_model("")
    for values in (model.rise_odds, model.slope_odds):
        assert (np.diff(values) >= 0.0).all()
    assert model.provenance


def test_where_the_probability_is_the_same_the_score_decides():
    """In the middle of bare ground no place is more probable: the first is far from the rock."""
    config = configured(domain={"size": 32.0})
    cells = mapped(config, block, density=60.0).snapshot()
    with mock.patch.object(score, "DISTANCE_CAP", 12.0):
        found = probable(dispersion=0.1).assess(cells)
    first = found.sites.position[0, :2]
    best = found.probability == found.probability[found.safe].max()
    assert best.sum() > 100
    row, column = divmod(int(np.argmin(np.where(best, found.score, np.inf))), len(found.x))
    np.testing.assert_allclose(first, (found.x[column], found.y[row]))
