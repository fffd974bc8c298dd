# SPDX-License-Identifier: Apache-2.0
"""A prior map: its planes, what leaves make of it, its offset from the map, where to look first."""

import numpy as np
import pytest
from core.builders import configured, leaf_at, look
from core.scenes import flat, lattice, make_pose, pose_covariance, scattered
from scipy.ndimage import gaussian_filter

from quadtree_lss.onboard.config.settings import PriorConfig
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.mapping.prior_offset import JUDGED, PriorMatch
from quadtree_lss.onboard.core.tree.domain import Domain
from quadtree_lss.onboard.core.tree.prior import FAR, Prior, smoothed
from quadtree_lss.onboard.elevation.look_first import look_first

SURE = {"sigma": 0.1, "offset_sigma": 0.0, "height_sigma": 0.0}


def hills(x, y):
    """Ground that no shift maps to itself; slopes up to 0.3."""
    return 2.0 * np.sin(0.11 * x + 0.05 * y) + 1.5 * np.cos(0.07 * y - 0.03 * x + 1.0)


def prior_of(surface, low=-60.0, high=80.0, step=2.0, rng=None, **how):
    """Posts on a surface, with noise where there is a generator."""
    config = PriorConfig(file="made", **how)
    axis = np.arange(low, high, step)
    z = surface(*np.meshgrid(axis, axis))
    if rng is not None:
        z = z + rng.normal(0.0, config.sigma, z.shape)
    return Prior(axis, axis.copy(), z, config)


@pytest.mark.parametrize("side", [4.0, 14.0])
def test_planes_are_least_squares_and_err_as_they_say(side):
    """Against ``lstsq`` of the window, and the scatter over draws of the posts."""
    rng, axis = np.random.default_rng(1), 2.0 * np.arange(11)
    x, y = (a.ravel() for a in np.meshgrid(axis, axis))
    config = PriorConfig(file="made", sigma=0.4, offset_sigma=0.0)
    domain = Domain(0.0, 0.0, 20.0, 1, 3)
    half = max(round(0.25 * side), 1)
    near = (np.abs(x - 10.0) <= 2.0 * half) & (np.abs(y - 10.0) <= 2.0 * half)
    rows = np.column_stack([np.ones(near.sum()), x[near] - 10.0, y[near] - 10.0])
    found = []
    for k in range(250):
        z = 3.0 + 0.2 * x - 0.1 * y + rng.normal(0.0, config.sigma, len(x))
        planes = Prior(axis, axis, z.reshape(11, 11), config).planes(domain, side)
        assert planes is not None
        at = planes.at(planes.fields, *np.full((2, 1), 10.0))[:, 0]
        if k < 3:
            np.testing.assert_allclose(at[:3], np.linalg.lstsq(rows, z[near])[0], atol=1e-9)
        found.append(at)
    scatter = np.var(found, axis=0)
    np.testing.assert_allclose(scatter[0], planes.height, rtol=0.3)
    np.testing.assert_allclose(scatter[1:3], planes.slope, rtol=0.3)
    assert np.mean(found, axis=0)[3] < 0.25 * config.sigma**2  # the ground is a plane


def test_leaves_begin_from_the_shifted_ground_with_the_offsets_covariance():
    """On a tilted plane by hand: z(x - d) + u, and J P J^T + the posts' share."""
    a, b = 0.2, -0.1
    prior = prior_of(lambda x, y: a * x + b * y, offset_sigma=1.5)
    domain = Domain(0.0, 0.0, 16.0, 2, 4)
    planes = prior.planes(domain, 4.0)
    offset, covariance = np.array([3.0, -2.0, 0.5]), np.diag([2.25, 1.0, 0.04])
    found = planes.beginning(domain, offset, covariance).reshape(4, 4, 5)
    x, y = 10.0 - 3.0, 6.0 + 2.0
    np.testing.assert_allclose(found[1, 2, :3], [a * x + b * y + 0.5, a, b], atol=1e-6)
    j = np.array([-a, -b, 1.0])
    np.testing.assert_allclose(found[1, 2, 4], j @ covariance @ j + planes.height, rtol=0.03)
    np.testing.assert_allclose(found[1, 2, 3], planes.slope, rtol=0.01)


def test_wide_normal_distributions_are_those_of_the_filter():
    field = np.random.default_rng(4).normal(size=(60, 90))
    for sigma in ((70.0, 3.0), (0.5, 900.0)):
        expected = gaussian_filter(field, sigma, mode="constant", truncate=FAR)
        np.testing.assert_allclose(smoothed(field, np.array(sigma)), expected, atol=1e-14)


def test_a_place_without_posts_is_not_covered():
    prior = prior_of(hills, offset_sigma=0.0)
    prior.elevation[:, prior.x > 8.0] = np.nan
    domain = Domain(0.0, 0.0, 16.0, 2, 4)
    found = prior.planes(domain, 4.0).beginning(domain, np.zeros(3), np.zeros((3, 3)))
    known = np.isfinite(found).reshape(4, 4, 5).all(axis=-1)
    assert known[:, 0].all() and not known[:, 2:].any()
    assert PriorMatch(prior, domain).found.covered == known.mean()
    assert prior.planes(Domain(900.0, 0.0, 16.0, 2, 4), 4.0) is None
    prior.elevation[::2] = np.nan  # no window is whole
    assert prior.planes(domain, 4.0) is None


def test_a_leaf_is_the_mean_of_what_points_and_prior_say():
    """Weighted by information, as two measurements of one height are, on level ground."""
    config = configured(noise=1.0, levels=(2, 2))
    plain, begun = Mapper(config), Mapper(config, prior_of(flat(0.2), **SURE))
    x, y = lattice(4.0, 4.0, 4.0, 12)
    for mapper in (plain, begun):
        look(mapper, flat(), x, y, np.random.default_rng(4), noise=1.0)
    one, both = leaf_at(plain, 6.0, 6.0), leaf_at(begun, 6.0, 6.0)
    planes = prior_of(flat(), **SURE).planes(begun.domain, 4.0)
    weight = np.array([1.0 / one.range_part[8], 1.0 / planes.height])
    assert both.z == pytest.approx(weight @ [one.z, 0.2] / weight.sum(), abs=5e-3)
    assert both.range_part[8] == pytest.approx(1.0 / weight.sum(), rel=0.05)
    assert both.range_part[0] < one.range_part[0]
    again = both.z, both.range_part[8]
    look(begun, flat(), x, y, np.random.default_rng(5), noise=1.0)
    share = again[1] / (again[1] + one.range_part[8])  # the prior counts once
    assert leaf_at(begun, 6.0, 6.0).range_part[8] == pytest.approx(again[1] * (1 - share), rel=0.1)


def three_looks(mapper, surface, seed=3):
    """Over all of the square but its eastern quarter."""
    rng = np.random.default_rng(seed)
    for k in range(3):
        x, y = scattered(rng, 0.0, 0.0, 64.0, 60_000)
        x *= 0.75
        pose = make_pose((32.0, 32.0, 500.0), pose_covariance(0.02, 1e-5), stamp_ns=1 + 10**8 * k)
        look(mapper, surface, x, y, rng, noise=0.06, pose=pose)
    return mapper


SQUARE = configured(domain={"size": 64.0, "min_level": 4, "max_level": 7})


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        (lambda x, y: hills(x + 400.0, y - 300.0), "another place"),
        (lambda x, y: hills(x, y) / 0.3048, "unit"),
        (lambda x, y: hills(x, y) + 700.0, "datum"),
    ],
)
def test_a_wrong_prior_is_refused_and_costs_nothing_after_three_looks(wrong, word):
    prior = prior_of(wrong, rng=np.random.default_rng(2), offset_sigma=4.0)
    plain, begun = (three_looks(Mapper(SQUARE, p), hills) for p in (None, prior))
    found = begun.prior_offset
    assert word in found.refused and found.cells >= JUDGED and word in found.doubt
    one, other = plain.snapshot(), begun.snapshot()
    places = np.meshgrid(np.arange(0.5, 47.0), np.arange(0.5, 64.0))
    ground, beside = one.at(*places), other.at(*places)
    known = np.isfinite(ground.height)
    off = np.abs(beside.height - ground.height)[known] / ground.deviation[known]
    assert known.all() and np.quantile(off, 0.99) < 0.2 and np.median(off) < 0.02


def test_a_right_prior_is_kept_and_its_offset_found():
    """Height first, east and north by the slopes; within four deviations."""
    true, squares = np.array([5.0, -3.0, 1.2]), []
    for seed in range(3):
        prior = prior_of(
            lambda x, y: hills(x + true[0], y + true[1]) - true[2],
            rng=np.random.default_rng(seed),
            offset_sigma=6.0,
            height_sigma=3.0,
        )
        found = three_looks(Mapper(SQUARE, prior), hills, seed).prior_offset
        assert not found.doubt and found.cells == 192 and found.covered == 1.0
        off = found.offset - true
        squares.append(off**2 / found.covariance.diagonal())
        assert np.abs(off[:2]).max() < 2.5 and abs(off[2]) < 0.3
        assert found.covariance[2, 2] < 0.1 * min(found.covariance[0, 0], found.covariance[1, 1])
    assert np.max(squares) < 16.0


def test_height_is_known_before_the_place():
    prior = prior_of(flat(4.0), offset_sigma=8.0, height_sigma=10.0)
    match = PriorMatch(prior, Domain(0.0, 0.0, 64.0, 4, 7))
    match.compare(10.0, 10.0, 7.0)
    east, north, up = np.sqrt(match.found.covariance.diagonal())
    assert match.found.offset[2] == pytest.approx(3.0, abs=0.1) and up < 0.5
    assert min(east, north) == pytest.approx(8.0, rel=0.05)  # level ground says nothing of it


def test_the_prior_makes_no_ground_seen_or_known():
    """Not even under a prior as sure as can be: what no scan saw is no map, and no site."""
    prior = prior_of(flat(), **SURE)
    plain, begun = (three_looks(Mapper(SQUARE, p), flat(), seed=2) for p in (None, prior))
    one, other = plain.snapshot(), begun.snapshot()
    for name in ("observed", "known", "measured", "estimated", "count", "level"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    found = LandingSiteSelector(SQUARE).assess(other)
    assert len(found.sites) and not found.safe[:, found.x > 48.0].any()
    empty = Mapper(SQUARE, prior).snapshot()
    assert not (empty.estimated.any() or empty.observed.any())
    assert not len(LandingSiteSelector(SQUARE).assess(empty).sites)
    # A line of points tells no plane, whatever the prior knows of its slope.
    line, x, pose = Mapper(SQUARE, prior), np.linspace(0.5, 3.5, 40), make_pose((2.0, 2.0, 500.0))
    look(line, flat(), x, 0.0 * x + 2.0, np.random.default_rng(1), noise=0.06, pose=pose)
    assert not line.snapshot().measured.any()


def test_a_prior_of_elsewhere_changes_no_bit():
    """It says nothing here; and neither does a map without one look different for the code."""
    prior = prior_of(hills, low=5000.0, high=5100.0)
    plain, begun = (three_looks(Mapper(SQUARE, p), hills) for p in (None, prior))
    for name, values in plain.export_state().items():
        assert values.tobytes() == begun.export_state()[name].tobytes(), name
    assert "covers nothing" in begun.prior_offset.doubt and plain.prior_offset is None


def test_what_leaves_begin_from_goes_along_with_the_square():
    config = configured(
        domain={"size": 64.0, "min_level": 4, "max_level": 6, "follow": "vehicle"},
        lss={"grid_spacing": 0.5},
    )
    prior = prior_of(hills, offset_sigma=2.0)
    match = PriorMatch(prior, Domain.of(config.domain))
    here = match.beginning(Domain.of(config.domain)).reshape(16, 16, 5)
    there = match.beginning(Domain.of(config.domain).moved(3, -2)).reshape(16, 16, 5)
    both = np.isfinite(here[:-2, 3:]) & np.isfinite(there[2:, :-3])
    assert both.mean() > 0.9
    np.testing.assert_allclose(there[2:, :-3][both], here[:-2, 3:][both], atol=0.02)


def test_a_map_taken_up_is_compared_anew():
    prior = prior_of(hills, rng=np.random.default_rng(1), offset_sigma=4.0)
    before = three_looks(Mapper(SQUARE, prior), hills)
    after = Mapper(SQUARE, prior)
    after.import_state(before.export_state())
    three_looks(after, hills, seed=8)
    np.testing.assert_allclose(after.prior_offset.offset, before.prior_offset.offset, atol=1.0)
    after.reset()
    assert after.prior_offset.cells == 0 and np.abs(after.prior_offset.offset).max() < 1e-9


def test_to_look_first_is_where_the_ground_is_even():
    """A slope of 30 degrees in the west, level ground in the east; the offset blurs the border."""

    def ground(x, y):
        return np.where(x < 30.0, 0.6 * (30.0 - x), 0.0) + 0.0 * y

    domain = Domain(0.0, 0.0, 64.0, 4, 7)
    by = [prior_of(ground, sigma=0.1, offset_sigma=sigma) for sigma in (0.5, 8.0)]
    sure, shifted = (look_first(prior, domain, SQUARE) for prior in by)
    for places in (sure, shifted):
        assert places and places[0].x > 35.0 and places[0].slope_deg < 2.0
        assert all(a.x < 64.0 and abs(a.z) < 20.0 for a in places)
        assert all(np.hypot(a.x - b.x, a.y - b.y) > 10.0 for a in places for b in places if a != b)
    assert shifted[0].ease < sure[0].ease <= 1.0
    near = look_first(by[0], domain, SQUARE, [55.0, 20.0])
    assert np.hypot(near[0].x - 55.0, near[0].y - 20.0) < 6.0
    empty = prior_of(ground)
    empty.elevation[:] = np.nan
    assert look_first(empty, domain, SQUARE) == ()
