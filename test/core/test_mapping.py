# SPDX-License-Identifier: Apache-2.0
"""The mapper as a whole: recovered ground, division, inheritance, bounds, invariances."""

import numpy as np
import pytest
from core.builders import METHODS, assert_same, assert_sound, by, configured, look, mapped
from core.scenes import (
    ABOVE,
    GROUND,
    flat,
    lattice,
    make_pose,
    pose_covariance,
    scan,
    scattered,
    slope,
)

from quadtree_lss.onboard.core.geometry import morton
from quadtree_lss.onboard.core.geometry.rotations import exp
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose


@pytest.mark.parametrize("paper", METHODS)
def test_every_method_divides_at_a_step_and_not_on_a_slope(paper):
    config = configured(mapping={"paper": paper}, noise=0.03)
    even = mapped(config, GROUND, density=30.0, scans=3)
    assert even.leaves.count == 4**config.domain.min_level
    stepped = mapped(config, lambda x, y: 0.5 * (x > 5.1), density=60.0, scans=3)
    cells = stepped.snapshot()
    assert_sound(cells)
    assert cells.estimated.all()
    at_step = np.abs(cells.x - 5.1) <= 0.5 * cells.size
    if paper not in ("division", "all"):
        assert (cells.level[at_step] >= 5).all()
    else:
        assert cells.level[at_step].max() > config.domain.min_level
    far = np.abs(cells.x - 5.1) > 4.0
    assert (cells.level[far] == config.domain.min_level).all()


def test_the_papers_criterion_hides_misfit_behind_pose_uncertainty():
    """With metre-level poses a step of 0.3 m passes for noise; the lack of fit shows it."""
    counts = []
    for paper in ("none", "division"):
        config = configured(mapping={"paper": paper}, noise=0.03)
        mapper, rng = Mapper(config), np.random.default_rng(5)
        pose = make_pose(ABOVE, pose_covariance(0.5, 1e-12))
        places = scattered(rng, 0, 0, 16, 10_000)
        look(mapper, lambda x, y: 0.3 * (x > 5.1), *places, rng, 0.03, pose)
        counts.append(mapper.leaves.count)
    assert counts[0] > 50 and counts[1] == 16


def test_children_without_points_inherit_and_no_hole_appears():
    """Every 8 m cell has points in its western half alone, with a step there."""
    config = configured(domain={"min_level": 1}, noise=0.03)
    rng, mapper = np.random.default_rng(6), Mapper(config)
    x, y = lattice(0.0, 0.0, 16.0, 160)  # four points or more in the finest cells
    west = (x % 8.0) < 4.0
    look(mapper, lambda x, y: 1.0 + 0.4 * ((x % 8.0) > 2.1), x[west], y[west], rng, 0.03)
    cells = mapper.snapshot()
    assert_sound(cells)
    assert cells.estimated.all()
    empty = (cells.x % 8.0) - 0.5 * cells.size >= 4.0
    assert empty.any()
    assert not cells.measured[empty].any()
    assert (cells.count[empty] == 0).all()
    assert np.isnan(cells.roughness[empty]).all()
    assert cells.measured[(cells.x % 8.0) + 0.5 * cells.size <= 4.0].all()
    # An inherited plane is less certain than any that was measured beside it.
    assert cells.covariance[empty, 2, 2].min() > np.median(cells.covariance[cells.measured, 2, 2])
    # Points that arrive later end the inheritance.
    x, y = x[~west], y[~west]
    look(mapper, flat(1.4), x, y, rng, 0.03)
    later = mapper.snapshot()
    assert later.measured[(later.x % 8.0) - 0.5 * later.size >= 4.0].all()
    np.testing.assert_allclose(later.at(x, y).height, 1.4, atol=0.1)


def test_where_returns_stand_out_is_remembered():
    """By the last look, if they are more than a sixteenth: 7 of 100 a cell."""
    config = configured(levels=(4, 4), noise=0.01)
    mapper, rng = Mapper(config), np.random.default_rng(9)
    x, y = lattice(0.0, 0.0, 16.0, 160)
    cell = np.flatnonzero((np.floor(x) == 5) & (np.floor(y) == 9))
    for raised in (0, 0, 0, 6, 7, 0):
        z = np.zeros(len(x))
        z[cell[3 : 3 + 12 * raised : 12]] = 1.0
        look(mapper, lambda x, y, z=z: z, x, y, rng, 0.01)
        expected = np.full(256, 2)
        expected[morton.encode(5, 9)] = 3 if raised == 7 else 2
        np.testing.assert_array_equal(mapper.leaves.observed, expected)


def test_the_stamp_is_the_newest_since_time_jumped_back():
    mapper = Mapper(configured())
    x, y = scattered(np.random.default_rng(9), 0.0, 0.0, 16.0, 500)
    second, hour = 10**9, 3600 * 10**9
    stamps = (500, 900, 700, 900 + hour, 2 * second, 2 * second - 1, second, 3 * second, -hour)
    expected = (500, 900, 900, 900 + hour, 2 * second, 2 * second, 2 * second, 3 * second, -hour)
    for stamp, newest in zip(stamps, expected, strict=True):
        look(mapper, flat(), x, y, pose=make_pose(stamp_ns=stamp))
        assert mapper.snapshot().stamp_ns == newest


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.full((5, 3), np.nan),
        np.full((4, 6, 3), np.inf),
        np.zeros((7, 3)),
        np.full((3, 3), 1e300),
        np.tile([3000.0, 0.0, 500.0], (9, 1)),
    ],
    ids=["none", "nan", "inf", "zero range", "huge", "outside"],
)
def test_a_scan_without_sound_points_changes_nothing(points):
    mapper = mapped(configured(), GROUND, density=20.0, scans=1)
    before = mapper.snapshot()
    report = mapper.update(points, make_pose(stamp_ns=10**15))
    assert report.points_used == 0
    assert report.points == points.size // 3 == sum(report.dropped.values())
    assert_same(before, mapper.snapshot())


@pytest.mark.parametrize("how", ["the same", "organised", "none", "fit"])
def test_order_and_form_of_points_do_not_matter(how):
    """To the bit if the order is the same, organised or not; else beyond the rounding of sums."""
    fit = {"paper": how} if how in METHODS else {}
    config = configured(mapping=fit)
    rng, pose = np.random.default_rng(11), make_pose(ABOVE, pose_covariance(0.1, 1e-4))
    x, y = lattice(0.0, 0.0, 16.0, 110)
    points = scan(lambda x, y: 1.0 * (x > 5.1) + 0.3 * np.sin(y), x, y, pose, 0.05, rng)
    other = points[rng.permutation(len(points))] if fit else points
    maps = []
    for cloud in (points, other.reshape(110, 110, 3) if how == "organised" else other):
        with by(**({"FEATURE_HEIGHT": np.inf} if fit else {})):
            mapper = Mapper(config)
        mapper.update(cloud, pose)
        maps.append(mapper.snapshot())
    assert_same(*maps, 1e-7 if fit else 0.0)


@pytest.mark.parametrize("paper", ["none", "all"])
@pytest.mark.parametrize("mirror", [np.diag([-1.0, 1.0, 1.0]), np.eye(3)[[1, 0, 2]]])
def test_a_mirrored_world_gives_the_mirrored_map(mirror, paper):
    """Neither axis is another than the other, neither way along it, and pose errors go along."""
    config, aside = configured(mapping={"paper": paper}), np.diag([-1.0, 1.0, 1.0])
    one, other = Mapper(config), Mapper(config)
    rng, middle = np.random.default_rng(12), np.array([8.0, 8.0, 0.0])
    errors = np.zeros((6, 6))
    errors[:3, :3], errors[3:, 3:] = mirror, -mirror  # rotations turn the other way
    for k in range(6):
        root = np.repeat([0.01, 2e-4], 3)[:, None] * rng.standard_normal((6, 6))
        turn = exp(rng.standard_normal(3))
        place = middle + rng.uniform(-15.0, 15.0, 3) + (0.0, 0.0, 40.0)
        pose = Pose(1 + k * 10**8, place, turn, root @ root.T)
        x, y = scattered(rng, *rng.uniform(-2.0, 8.0, 2), 10.0, 3000)
        points = scan(lambda x, y: 1.0 * (x > 5.1) + 0.3 * np.sin(y), x, y, pose, 0.05, rng)
        one.update(points, pose)
        there = mirror @ (place - middle) + middle, mirror @ turn @ aside
        told = Pose(pose.stamp_ns, *there, errors @ pose.covariance @ errors.T)
        other.update(points @ aside, told)
    cells, mirrored = one.snapshot(), other.snapshot()
    x, y = lattice(0.0, 0.0, 16.0, 64)
    found = cells.at(x, y)
    away = mirror @ np.array([x - 8.0, y - 8.0, 0.0 * x]) + middle[:, None]
    for a, b in zip(found, mirrored.at(*away[:2]), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)
    assert len(cells.level) == len(mirrored.level) > 100
    assert np.isfinite(found.height).any()


@pytest.mark.parametrize(("scans", "points"), [(1, 6000), (5, 512)])
def test_a_shifted_world_gives_the_shifted_map(scans, points):
    """Far from the frame's origin too: 20 km away, with 3 km of height; of two points a cell and
    scan as of many."""
    maps, domain = [], {} if scans == 1 else {"min_level": 4, "max_level": 4}
    for at in (np.zeros(3), np.array([20_000.0, -20_000.0, 3_000.0])):
        mapper = Mapper(configured(domain={"xmin": at[0], "ymin": at[1], **domain}, noise=0.03))
        rng = np.random.default_rng(13)
        for k in range(scans):
            place = np.array([8.0, 8.0, 500.0] if scans == 1 else [-180.0, 8.0 + 20.0 * k, 120.0])
            x, y = scattered(rng, 0.0, 0.0, 16.0, points)
            ground = slope(0.1, 0.05) if scans > 1 else lambda x, y: 0.5 * (x > 5.1)
            local = scan(ground, x, y, make_pose(tuple(place)), 0.03, rng)
            mapper.update(local, make_pose(tuple(place + at), pose_covariance(0.1, 1e-4), k + 1))
        maps.append(mapper.snapshot())
    one, other = maps
    assert one.measured.sum() > 50
    np.testing.assert_array_equal(one.level, other.level)
    np.testing.assert_array_equal(one.measured, other.measured)
    np.testing.assert_allclose(other.z - 3_000.0, one.z, atol=1e-7)
    np.testing.assert_allclose(other.normal, one.normal, atol=1e-6)
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-3, atol=1e-9)
