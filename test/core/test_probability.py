# SPDX-License-Identifier: Apache-2.0
"""Probability of a safe touchdown: the fit looked up, dispersion, ranking, and what is left."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from core.builders import configured, flat, look, make_pose, mapped
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from quadtree_lss.lab.evaluation.risk_fit import FEATURES, risks
from quadtree_lss.onboard.config.risk import LOCAL, Cause, Curve, RiskModel, risk_model
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.aim import Dispersion, touchdown_weights, unsafe_aims
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.landing.contact import ContactCheck
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.core.landing.risk import RiskTable, contact_limits, height_noise
from quadtree_lss.onboard.core.mapping.mapper import Mapper

Array = NDArray[np.float64]

MODEL = RiskModel(
    seen=(0.0, 2.0),
    causes={
        "obstacle": Cause(
            -7.0,
            (
                Curve("rise", (0.5, 1.0, 1.4), ((0.0, 2.0, 6.0), (0.0, 1.0, 8.0))),
                Curve("rise_beside", (0.5, 1.5), ((0.0, 3.0), (0.0, 4.0))),
                Curve("relief", (0.0, 0.2, 0.7), ((0.0, 0.5, 1.0),)),
                Curve("cell", (-0.1, 0.4), ((0.0, 1.5),)),
            ),
        ),
        "slope": Cause(
            -6.0,
            (
                Curve("tilt", (0.6, 1.3), ((0.0, 5.0),)),
                Curve("tilt_beside", (0.6, 1.3), ((0.0, 4.0),)),
                Curve("gradient", (0.1, 0.9), ((0.0, 1.0), (0.0, 3.0))),
            ),
        ),
        "hidden": Cause(
            -3.0,
            (
                Curve("seen", (-1.0, 1.0, 2.5), ((0.0, -2.0, -5.0),)),
                Curve("roughness", (0.0, 0.5), ((0.0, 2.0),)),
                Curve("noise", (-1.0, -0.5), ((0.0, 1.0),)),
                Curve("clearance", (-1.2, -0.8), ((0.0, -1.0),)),
                Curve("lean", (0.0, 0.4), ((0.0, -1.0),)),
            ),
        ),
    },
)


def block(x: Array, y: Array) -> Array:
    """One of 1.4 m, 0.6 m high, on level ground."""
    return 0.6 * ((np.abs(x - 16.0) < 0.7) & (np.abs(y - 16.0) < 0.7))


def square_means(values: Array, low: int, high: int, size: int) -> Array:
    """Of those of the lattice within squares [i - low, i + high) about each place."""
    out = np.empty((size, size))
    for i, j in np.ndindex(out.shape):
        out[i, j] = values[max(i - low, 0) : i + high, max(j - low, 0) : j + high].mean()
    return out


@pytest.fixture(scope="module")
def rough_ground():
    """A map of rocks on an incline of which a part was seen a little and a part not at all."""
    config = configured(domain={"size": 32.0, "max_level": 6}, lss={"risk_model": ""})
    rng = np.random.default_rng(7)
    places = rng.uniform(0.0, 32.0, (40, 2))

    def rocks(x: Array, y: Array) -> Array:
        z = 0.1 * x
        for east, north in places:
            z = z + 0.4 * (np.hypot(x - east, y - north) < 0.4)
        return z

    cells = mapped(config, rocks, density=40.0).snapshot()
    observed = cells.observed & (rng.random(cells.observed.shape) < 0.97)
    observed[:, :12] = False
    return config, replace(cells, observed=observed, known=cells.known & observed)


def landed(config, cells):
    lss = config.lss
    terrain = rasterise(cells, lss)
    check = ContactCheck(lss, contact_limits(MODEL, lss))
    return terrain, check.contacts(terrain, terrain.needs_contact)


def test_what_is_asked_of_places_is_as_its_definitions_say(rough_ground):
    config, cells = rough_ground
    terrain, contacts = landed(config, cells)
    judged, planes, given = terrain.assessable, terrain.planes, (terrain, contacts)
    table = RiskTable(MODEL, config.lss, 0.06)
    found = dict(zip(LOCAL, table.features(*given), strict=True))
    side, c, steep = terrain.domain.finest_size, 0.3, np.tan(np.radians(10.0))
    size, seen = len(judged), ~terrain.bridged
    for name, contact, limit, least in (
        ("rise", contacts.rise, c, 0.5),
        ("tilt", contacts.tilt, steep, 0.6),
    ):
        own = np.fmax(contact / limit, least)
        np.testing.assert_allclose(found[name], own, rtol=1e-5)
        padded = np.pad(own, 1, constant_values=-np.inf)
        four = padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]
        beside = np.maximum.reduce([own, *four])
        np.testing.assert_allclose(found[f"{name}_beside"], beside, rtol=1e-5)
    count = np.bincount(terrain.leaf[seen], minlength=len(cells.level))
    with np.errstate(divide="ignore"):
        independent = -16.0 * np.log(1.0 - cells.coverage)
    returns = np.minimum(cells.count / np.maximum(count, 1), independent)
    estimated = np.isfinite(cells.z)
    heights = np.full(len(cells.level), np.inf)
    heights[estimated] = 1.0 / np.linalg.inv(cells.covariance_range[estimated])[:, 2, 2]
    share = np.clip(heights * cells.count / 0.06**2, 1e-3, 1.0)
    assert np.median(share) < 1.0
    returns = (returns / share)[terrain.leaf]
    density = np.pad(np.where(seen, returns * (c / side) ** 2, 0.0), 1, mode="edge")
    density = sliding_window_view(density, (3, 3)).mean(axis=(2, 3))
    known = np.log10(density + 1e-3)
    under = round(0.45 * 3.7 / side)
    expected = square_means(known, under, under, size)
    expected -= 3.0 * np.log10(side / c / 0.85)  # noise is 0.2 clearances
    np.testing.assert_allclose(found["seen"], expected, atol=1e-4)
    rough = np.nan_to_num(cells.roughness / cells.size**2)[terrain.leaf] / c * seen
    rough = np.sqrt(square_means(rough, under, under, size))
    np.testing.assert_allclose(found["roughness"], rough, atol=1e-4)
    corners = sliding_window_view(planes.elevation, (2, 2)).mean(axis=(2, 3))
    over = np.clip((terrain.elevation - corners) / c, 0.0, 5.0) * terrain.observed
    assert (over > 1.0).any()
    relief = np.sqrt(square_means(over**2, under, under, size))
    np.testing.assert_allclose(found["relief"], relief, atol=1e-4)
    np.testing.assert_allclose(found["gradient"], planes.gradient / steep, rtol=1e-5)
    reach = round(4.0 * 3.7 / side)
    tall = np.pad((over > 1.0) & seen, 1)
    tall = sliding_window_view(tall, (3, 3)).any(axis=(2, 3))
    raised = square_means(1.0 * ((over > 0.5) & seen & ~tall), reach, reach, size)
    told = square_means(1.0 - np.exp(-density), reach, reach, size)
    share = np.log10((raised + 0.02 / 64.0) / (told + 1.0 / 64.0))
    off = np.abs(found["abundance"] - share)  # of squares of several cells, not of single ones
    assert np.median(off) < 0.03
    assert np.quantile(off, 0.95) < 0.15
    assert np.ptp(share) > 0.4


@pytest.mark.parametrize("noise", [0.06, 0.03])
def test_the_fit_is_looked_up_as_its_equations_say(rough_ground, noise):
    config, cells = rough_ground
    terrain, contacts = landed(config, cells)
    table, judged = RiskTable(MODEL, config.lss, noise), terrain.assessable
    found, cause = table.risk(terrain, contacts)
    asked = table.features(terrain, contacts)[:, judged].astype(float)
    of = dict(zip(LOCAL, asked, strict=True))
    of |= {"noise": np.log10(noise / 0.3), "cell": np.log10(terrain.domain.finest_size / 0.3)}
    of["clearance"] = np.log10(0.3 / 3.7)
    of["lean"] = np.log10(3.7 * np.tan(np.radians(10.0)) / np.sqrt(2.0) / 0.3)
    odds = []
    for one in MODEL.causes.values():
        z = np.full(int(judged.sum()), one.constant)
        for curve in one.curves:
            rows = [np.interp(of[curve.feature], curve.knots, row) for row in curve.odds]
            share = np.interp(of["seen"], MODEL.seen, (0.0, 1.0)) if len(rows) > 1 else 0.0
            z += (1.0 - share) * rows[0] + share * rows[-1]
        odds.append(z)
    expected = 1.0 - np.prod([1.0 / (1.0 + np.exp(z)) for z in odds], axis=0)
    logit = [np.log(p / (1.0 - p)) for p in (found[judged], expected)]
    np.testing.assert_allclose(*logit, atol=0.2)
    assert np.abs(logit[0] - logit[1]).mean() < 0.05
    assert (found[~judged] == 1.0).all()
    first, second = np.sort(odds, axis=0)[[-1, -2]]
    clear = first > second + 0.4
    assert (cause[judged][clear] == np.argmax(odds, axis=0)[clear]).all()


def test_more_that_speaks_against_a_place_never_lowers_its_risk():
    """Of the shipped model: returns alone lower it."""
    rng, model = np.random.default_rng(8), risk_model("")
    low, high = np.transpose([model.span(name) for name in FEATURES])
    places = rng.uniform(low, high, (4000, len(FEATURES)))
    risk = risks(model, places)
    for k, name in enumerate(LOCAL):
        if name == "seen":
            continue
        more = places.copy()
        more[:, k] += rng.uniform(0.0, 1.0, len(more)) * (high[k] - low[k])
        assert (risks(model, more) >= risk - 1e-12).all(), name
        assert (risks(model, more) > risk + 1e-6).any(), name
    never = dict.fromkeys(model.causes, Cause(-40.0, ()))
    hidden = replace(model, causes={**never, "hidden": model.causes["hidden"]})
    more = places.copy()
    more[:, LOCAL.index("seen")] += 0.5
    assert (risks(hidden, more) <= risks(hidden, places) + 1e-12).all()


def test_ground_that_no_return_is_from_raises_the_risk(rough_ground):
    """Level ground of which ever more cells are bridged."""
    config, cells = rough_ground
    leaves, none = np.ones(len(cells.level)), np.full(len(cells.level), np.nan)
    flat = replace(cells, z=leaves, normal=np.outer(leaves, [0.0, 0.0, 1.0]), low=none, high=none)
    flat = replace(flat, roughness=0.0 * leaves, feature=np.full_like(cells.feature, np.nan))
    flat = replace(flat, covariance_range=np.full_like(cells.covariance_range, np.nan))
    table, drawn = RiskTable(risk_model(""), config.lss, 0.06), np.random.default_rng(9)
    order, inner = drawn.random(cells.known.shape), np.s_[24:-12, 40:-12]
    told = []
    for share in (0.0, 0.1, 0.3):
        known = flat.known & (order >= share)
        left = np.bincount(cells.leaf_raster()[known], minlength=len(leaves))
        count = (4 * left).astype(np.uint32)  # so few that a cell without any may be chance
        thin = replace(flat, known=known, observed=known, count=count)
        told.append(table.risk(*landed(config, thin))[0][inner])
    for fewer, more in zip(told, told[1:], strict=False):
        assert (more >= fewer - 1e-6).mean() > 0.98
        assert (more > fewer).mean() > 0.5


@pytest.mark.parametrize("spread", [Dispersion(0.0, 0.4), Dispersion(0.1, 1.3)])
def test_an_aim_is_the_weighted_mean_of_the_risk_about_it(spread):
    risk, beyond = np.random.default_rng(5).random((19, 25)), 30
    around = np.pad(risk, beyond, constant_values=1.0)
    along_y, along_x = touchdown_weights((beyond, beyond), 0.25, spread)
    found = unsafe_aims(risk, 0.25, spread)
    for row, column in ((0, 0), (9, 12), (18, 3)):
        rows, columns = (
            np.arange(-(len(w) // 2), len(w) // 2 + 1) + at + beyond
            for w, at in ((along_y, row), (along_x, column))
        )
        expected = along_y @ around[np.ix_(rows, columns)] @ along_x
        assert found[row, column] == pytest.approx(expected, abs=1e-6)


def probable(**lss: object) -> LandingSiteSelector:
    given = {"assessment": "probability", "grid_spacing": 0.25, **lss}
    return LandingSiteSelector(configured(domain={"size": 32.0, "max_level": 7}, lss=given))


@pytest.fixture(scope="module")
def beside_a_rock():
    config = configured(domain={"size": 32.0, "max_level": 7})
    return mapped(config, block, density=600.0).snapshot()


def test_a_rock_is_bad_ground_and_what_is_far_from_it_is_safe(beside_a_rock):
    found = probable(dispersion=0.0).assess(beside_a_rock)
    at_rock = np.hypot(found.x[None] - 16.0, found.y[:, None] - 16.0)
    x, y = np.meshgrid(found.x, found.y)
    on_edge = np.minimum.reduce([x, y, 32.0 - x, 32.0 - y])
    assert found.risk[at_rock < 1.5].min() > 0.3
    far = (at_rock > 4.0) & (on_edge > 2.5)
    assert found.risk[far].max() < 0.005
    assert found.safe[far].all()
    assert (found.hazard[at_rock < 1.5] & hazards.TOUCHDOWN > 0).all()
    assert (found.hazard[at_rock < 1.0] & hazards.UNCERTAIN == 0).all()
    np.testing.assert_allclose(found.probability, 1.0 - found.risk, atol=1e-6)


def test_sites_are_ranked_by_the_probability_of_the_aim(beside_a_rock):
    found = probable(dispersion=1.0).assess(beside_a_rock)
    ranked = found.sites.probability
    assert len(ranked) == 5
    assert (np.diff(ranked) <= 1e-5).all()  # less does not matter: there the score decides
    assert ranked[0] == pytest.approx(found.probability[found.safe].max(), abs=1e-5)
    assert (np.hypot(*(found.sites.position[:1, :2] - 16.0).T) > 5.0).all()


@pytest.mark.parametrize("rule", ["probability", "touchdown"])
def test_a_heading_counts_for_limits_and_not_for_the_risk_fitted_to_the_worst(beside_a_rock, rule):
    heard: list[float | None] = []
    selector, contacts = probable(assessment=rule), ContactCheck.contacts

    def hear(check, raster, needed, heading=None):
        heard.append(heading)
        return contacts(check, raster, needed, heading)

    with mock.patch.object(ContactCheck, "contacts", hear):
        one = selector.assess(beside_a_rock, dispersion=[0.0, 0.0, 0.3])
    assert heard == [None if rule == "probability" else 0.3]
    every = selector.assess(beside_a_rock, dispersion=[0.0, 0.0])
    np.testing.assert_array_equal(one.risk, every.risk)


@pytest.mark.parametrize("given", [[1.0], [1.0, -1.0], [np.nan, 1.0], [1e9, 1.0], [1, 1, 0, 0]])
def test_what_is_no_dispersion_is_refused(beside_a_rock, given):
    with pytest.raises(ValueError, match="dispersion needs two standard deviations"):
        probable().assess(beside_a_rock, dispersion=given)


@pytest.mark.parametrize("elevation_deg", [90.0, 30.0, 8.0])
def test_noise_of_heights_follows_angle_of_incidence(elevation_deg):
    """The variance of heights over that of ranges is the squared sine of the ray's elevation."""
    rng, config = np.random.default_rng(3), configured(levels=(2, 4), noise=0.05)
    angle = np.radians(elevation_deg)
    pose = make_pose((8.0 - 60.0 * np.cos(angle), 8.0, 60.0 * np.sin(angle)))
    x, y = rng.uniform(0.0, 16.0, (2, 4000))
    mapper = Mapper(config)
    look(mapper, flat(), x, y, rng, noise=0.05, pose=pose)
    share = height_noise(mapper.snapshot(), 0.05)
    np.testing.assert_allclose(np.median(share), np.sin(angle) ** 2, rtol=0.3)


def test_noise_of_heights_is_that_of_ranges_where_there_is_no_plane():
    cells = mapped(configured(), flat()).snapshot()
    unknown = replace(cells, covariance_range=np.full_like(cells.covariance_range, np.nan))
    np.testing.assert_array_equal(height_noise(unknown, 0.05), 1.0)


def test_guidance_goes_before_the_configuration(beside_a_rock):
    selector = probable(dispersion=3.0)
    own = selector.assess(beside_a_rock).probability
    theirs = selector.assess(beside_a_rock, dispersion=[0.2, 0.1]).probability
    np.testing.assert_array_equal(
        theirs, 1.0 - unsafe_aims(selector.assess(beside_a_rock).risk, 0.25, Dispersion(0.2, 0.1))
    )
    assert theirs.max() > own.max()
