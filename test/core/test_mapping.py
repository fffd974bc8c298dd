# SPDX-License-Identifier: Apache-2.0
"""The mapper as a whole: recovered ground, division, inheritance, bounds, robustness."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from core.builders import (
    EXACT,
    configured,
    disturbed,
    elevation,
    flat,
    lattice,
    make_pose,
    mapped,
    plane_errors,
    pose_covariance,
    scan,
    scattered,
    slope,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from quadtree_lss.onboard.core.geometry.rotations import exp
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.cell_map import CellMap

GRADIENT = (0.12, -0.07)
NORMAL = np.array([-GRADIENT[0], -GRADIENT[1], 1.0]) / np.sqrt(1.0 + np.sum(np.square(GRADIENT)))
GROUND = slope(*GRADIENT, 30.0)
METHODS = list(
    itertools.product(("height", "ml"), ("common", "independent"), ("lack_of_fit", "mahalanobis"))
)


def errors(cells: CellMap) -> np.ndarray:
    """(M, 3) error of each cell's plane against GROUND, about (x, y, z) of the cell."""
    return plane_errors(cells, NORMAL, GROUND)


def nees(cells: CellMap) -> np.ndarray:
    error = errors(cells)
    return np.einsum("mi,mij,mj->m", error, np.linalg.inv(cells.covariance), error)


def assert_sound(cells: CellMap) -> None:
    """Every estimated leaf has a finite upward plane and a positive covariance."""
    known = cells.estimated
    assert (cells.measured <= known).all()
    assert (cells.normal[known, 2] > 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(cells.normal[known], axis=1), 1.0, atol=1e-9)
    total = np.einsum("mii->mi", cells.covariance[known])
    assert (total > 0.0).all()
    # Round-off leaves each part with errors of the whole's size. Of walls that is all there is.
    ground = cells.normal[known, 2] > 0.1
    scale = np.sqrt(total[ground, :, None] * total[ground, None, :])
    for part in (cells.covariance_range[known], cells.covariance_pose[known]):
        assert np.isfinite(part).all()
        assert np.linalg.eigvalsh(part[ground] / scale).min(initial=0.0) > -0.01
    assert np.isfinite(cells.roughness[cells.measured]).all()
    assert (cells.roughness[cells.measured] >= 0.0).all()
    fraction = cells.exception_fraction[cells.measured]
    assert ((fraction >= 0.0) & (fraction <= 1.0)).all()


def assert_equal(a: CellMap, b: CellMap, tolerance: float = 0.0) -> None:
    for field in dataclasses.fields(CellMap):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if tolerance and isinstance(one, np.ndarray) and one.dtype == np.float64:
            np.testing.assert_allclose(one, other, rtol=tolerance, atol=tolerance)
        else:
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("fit", ["height", "ml"])
def test_range_noise_alone_is_covered_by_the_covariance(fit):
    """256 cells of 4 m: their mean NEES is 3 within five times sqrt(6 / 256)."""
    config = configured(
        domain={"size": 64.0, "min_level": 4, "max_level": 4},
        lidar={"range_noise": 0.3},
        mapping={"fit": fit},
    )
    cells = mapped(config, GROUND, density=4.0, scans=3).snapshot()
    assert cells.measured.all()
    assert abs(nees(cells).mean() - 3.0) < 5.0 * np.sqrt(6.0 / 256)


@pytest.mark.parametrize("fit", ["height", "ml"])
def test_pose_and_range_noise_are_covered_by_the_covariance(fit):
    """300 independent maps of one cell, three scans each from the side, pose errors of 0.2 m."""
    config = configured(
        domain={"size": 2.0, "min_level": 0, "max_level": 0},
        lidar={"range_noise": 0.03},
        mapping={"fit": fit},
        pose={"correlation_time": 0.0},
    )
    rng = np.random.default_rng(2)
    found = []
    for _ in range(300):
        mapper = Mapper(config)
        for k in range(3):
            turn = exp(rng.normal(0.0, 0.3, 3)) @ np.diag([1.0, -1.0, -1.0])
            pose = make_pose((150.0, -90.0 + 30.0 * k, 300.0), pose_covariance(0.2, 5e-4), k, turn)
            x, y = scattered(rng, -0.5, -0.5, 3.0, 70)
            mapper.update(scan(GROUND, x, y, disturbed(pose, rng), 0.03, rng), pose)
        found.append(nees(mapper.snapshot())[0])
    assert abs(np.mean(found) - 3.0) < 5.0 * np.sqrt(6.0 / 300)


def test_pose_errors_of_half_a_metre_between_scans_do_not_tilt_the_ground():
    """gamma_j: the slope follows from within each scan, whatever lies between them."""
    config = configured(domain={"min_level": 4, "max_level": 4}, lidar={"range_noise": 0.02})
    rng = np.random.default_rng(3)
    mapper = Mapper(config)
    for k, offset in enumerate((0.5, -0.5, 0.3, -0.4)):
        pose = make_pose((8.0, 8.0, 500.0), pose_covariance(0.5, 1e-12), k)
        true = make_pose((8.0, 8.0, 500.0 + offset))
        x, y = scattered(rng, 0.0, 0.0, 16.0, 8000)
        mapper.update(scan(GROUND, x, y, true, 0.02, rng), pose)
    cells = mapper.snapshot()
    error = errors(cells)[:, :2]
    spread = cells.covariance[:, :2, :2]
    chi = np.einsum("mi,mij,mj->m", error, np.linalg.inv(spread), error)
    assert abs(chi.mean() - 2.0) < 5.0 * np.sqrt(4.0 / 256)
    assert np.abs(error).max() < 0.05


@pytest.mark.parametrize(("fit", "covariance", "division"), METHODS)
def test_every_method_divides_at_a_step_and_not_on_a_slope(fit, covariance, division):
    values = {"fit": fit, "covariance": covariance, "division": division}
    config = configured(mapping=values, lidar={"range_noise": 0.03})
    even = mapped(config, GROUND, density=30.0, scans=3)
    assert even.leaves.count == 4**config.domain.min_level
    stepped = mapped(config, lambda x, y: 0.5 * (x > 5.1), density=60.0, scans=3)
    cells = stepped.snapshot()
    assert_sound(cells)
    assert cells.estimated.all()
    at_step = np.abs(cells.x - 5.1) <= 0.5 * cells.size
    if division == "lack_of_fit":
        assert (cells.level[at_step] >= 5).all()
    else:
        assert cells.level[at_step].max() > config.domain.min_level
    far = np.abs(cells.x - 5.1) > 4.0
    assert (cells.level[far] == config.domain.min_level).all()


@pytest.mark.parametrize(("division", "threshold"), [("lack_of_fit", 1.2), ("mahalanobis", 2.4)])
def test_division_starts_at_its_threshold(division, threshold):
    """Noise f times the configured one has a mean distance of f E[chi_1] with an exact pose.

    lack_of_fit asks for 1.2 E[chi_1], the paper for 1.2 E[chi_3] = 2.4 E[chi_1]. The mean of
    5000 points errs by 0.75 / sqrt(5000) = 1 %.
    """
    config = configured(
        domain={"min_level": 0, "max_level": 1},
        mapping={"division": division},
        lidar={"range_noise": 0.02},
    )
    for factor, divided in ((0.93 * threshold, False), (1.07 * threshold, True)):
        mapper = mapped(config, GROUND, density=20.0, scans=1, noise=0.02 * factor)
        assert (mapper.leaves.count > 1) == divided


def test_the_papers_criterion_hides_misfit_behind_pose_uncertainty():
    """With metre-level poses a step of 0.3 m passes for noise; lack_of_fit sees it."""
    counts = {}
    for division in ("lack_of_fit", "mahalanobis"):
        config = configured(
            mapping={"division": division},
            lidar={"range_noise": 0.03},
            features={"enabled": False},
        )
        mapper = Mapper(config)
        rng = np.random.default_rng(5)
        pose = make_pose((8.0, 8.0, 500.0), pose_covariance(0.5, 1e-12))
        x, y = scattered(rng, 0.0, 0.0, 16.0, 10_000)
        mapper.update(scan(lambda x, y: 0.3 * (x > 5.1), x, y, pose, 0.03, rng), pose)
        counts[division] = mapper.leaves.count
    assert counts["mahalanobis"] == 16
    assert counts["lack_of_fit"] > 50


def test_elevation_of_stepped_ground():
    config = configured(lidar={"range_noise": 0.03})

    def ground(x, y):
        return 2.0 + 0.5 * (x > 5.1)

    cells = mapped(config, ground, density=100.0, scans=3).snapshot()
    x, y = lattice(0.0, 0.0, 16.0, 100)
    off = np.abs(elevation(cells, x, y) - ground(x, y))
    beside = np.abs(x - 5.1) > config.domain.size / 2**config.domain.max_level
    # 18 points a finest cell and three scans: 0.03 / sqrt(18) = 7 mm, a corner twice that.
    assert off[beside].max() < 0.1
    assert np.sqrt(np.mean(off[beside] ** 2)) < 0.01


def test_children_without_points_inherit_and_no_hole_appears():
    """Every 8 m cell has points in its western half alone, with a step there."""
    config = configured(domain={"min_level": 1}, lidar={"range_noise": 0.03})
    rng = np.random.default_rng(6)
    pose = make_pose((8.0, 8.0, 500.0))
    x, y = lattice(0.0, 0.0, 16.0, 160)  # four points or more in the finest cells
    mapper = Mapper(config)
    west = (x % 8.0) < 4.0
    mapper.update(
        scan(lambda x, y: 1.0 + 0.4 * ((x % 8.0) > 2.1), x[west], y[west], pose, 0.03, rng), pose
    )
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
    mapper.update(scan(flat(1.4), x[~west], y[~west], pose, 0.03, rng), pose)
    later = mapper.snapshot()
    assert later.measured[(later.x % 8.0) - 0.5 * later.size >= 4.0].all()
    x, y = x[~west], y[~west]
    np.testing.assert_allclose(elevation(later, x, y), 1.4, atol=0.1)


def test_points_are_all_accounted_for():
    config = configured(lidar={"min_range": 100.0, "max_range": 600.0})
    rng = np.random.default_rng(7)
    pose = make_pose((8.0, 8.0, 500.0))
    x, y = scattered(rng, -8.0, -8.0, 32.0, 4000)
    points = scan(flat(), x, y, pose, 0.03, rng)
    inside = (x >= 0.0) & (x < 16.0) & (y >= 0.0) & (y < 16.0)
    points[:50] = np.nan
    points[50:80, 1] = np.inf
    points[80:100] *= 0.1
    points[100:130] *= 10.0
    report = Mapper(config).update(points, pose)
    assert report.points == 4000
    assert report.dropped["no_return"] == 80
    assert report.dropped["range"] == 50
    # A point moves a millimetre sideways by its noise; one of them may change sides.
    assert abs(report.points_used - np.count_nonzero(inside[130:])) <= 2
    assert report.points_used + sum(report.dropped.values()) == report.points
    assert report.stamp_ns == pose.stamp_ns


def test_observed_is_where_points_fell_and_count_is_how_many():
    config = configured(domain={"min_level": 2, "max_level": 5})
    rng = np.random.default_rng(8)
    pose = make_pose((8.0, 8.0, 500.0))
    x, y = scattered(rng, 0.0, 0.0, 16.0, 600)
    mapper = Mapper(config)
    for _ in range(2):
        mapper.update(scan(flat(), x, y, pose, 0.0), pose)
    cells = mapper.snapshot()
    expected = np.zeros((32, 32), dtype=bool)
    expected[(y / 0.5).astype(int), (x / 0.5).astype(int)] = True
    np.testing.assert_array_equal(cells.observed, expected)
    assert (cells.level == 2).all()
    leaf = cells.leaf_raster()[(y / 0.5).astype(int), (x / 0.5).astype(int)]
    np.testing.assert_array_equal(cells.count, 2 * np.bincount(leaf, minlength=16))


def test_the_stamp_is_the_newest_since_time_jumped_back():
    mapper = Mapper(configured())
    x, y = scattered(np.random.default_rng(9), 0.0, 0.0, 16.0, 500)
    second, hour = 10**9, 3600 * 10**9
    stamps = (500, 900, 700, 900 + hour, 2 * second, 2 * second - 1, second, 3 * second, -hour)
    expected = (500, 900, 900, 900 + hour, 2 * second, 2 * second, 2 * second, 3 * second, -hour)
    for stamp, newest in zip(stamps, expected, strict=True):
        pose = make_pose(stamp_ns=stamp)
        mapper.update(scan(flat(), x, y, pose, 0.0), pose)
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
    assert_equal(before, mapper.snapshot())


def test_returns_of_no_range_at_all_do_not_spoil_a_cell():
    """(0, 0, 0) is what many drivers send for no return; also without a minimum range."""
    config = configured(lidar={"min_range": 0.0}, domain={"max_level": 2})
    mapper = mapped(config, GROUND, density=20.0, scans=1)
    x, y = scattered(np.random.default_rng(16), 0.0, 0.0, 4.0, 500)
    pose = make_pose((8.1, 8.1, 80.0))
    points = scan(GROUND, x, y, pose, 0.0)
    points[:2] = 0.0
    mapper.update(points, pose)
    assert_sound(mapper.snapshot())
    assert mapper.snapshot().measured.all()


def test_the_same_scans_give_the_same_bits():
    config = configured()

    def ground(x, y):
        return 0.4 * np.sin(x) * np.cos(0.7 * y)

    assert_equal(*(mapped(config, ground, density=50.0).snapshot() for _ in range(2)))


def test_a_snapshot_does_not_change_with_later_scans():
    mapper = mapped(configured(), GROUND, density=20.0, scans=1)
    kept = mapper.snapshot()
    copy = {
        f.name: np.copy(getattr(kept, f.name))
        for f in dataclasses.fields(CellMap)
        if isinstance(getattr(kept, f.name), np.ndarray)
    }
    x, y = scattered(np.random.default_rng(10), 0.0, 0.0, 16.0, 8000)
    pose = make_pose((8.0, 8.0, 500.0))
    mapper.update(scan(lambda x, y: np.sin(3.0 * x), x, y, pose, 0.0), pose)
    for name, values in copy.items():
        np.testing.assert_array_equal(getattr(kept, name), values)


@pytest.mark.parametrize("fit", ["height", "ml"])
def test_order_of_points_does_not_matter(fit):
    """Beyond the rounding of sums."""
    config = configured(mapping={"fit": fit}, features={"enabled": False})
    rng = np.random.default_rng(11)
    pose = make_pose((8.0, 8.0, 500.0), pose_covariance(0.1, 1e-4))
    x, y = scattered(rng, 0.0, 0.0, 16.0, 12_000)
    points = scan(lambda x, y: 0.4 * (x > 5.1) + 0.3 * np.sin(y), x, y, pose, 0.05, rng)
    one, other = Mapper(config), Mapper(config)
    one.update(points, pose)
    other.update(points[rng.permutation(len(points))], pose)
    assert_equal(one.snapshot(), other.snapshot(), 1e-7)


def test_organised_and_unorganised_points_are_one_scan():
    config = configured()
    rng = np.random.default_rng(12)
    pose = make_pose((8.0, 8.0, 500.0))
    x, y = lattice(0.0, 0.0, 16.0, 64)
    points = scan(lambda x, y: 0.5 * (x > 5.1), x, y, pose, 0.05, rng)
    one, other = Mapper(config), Mapper(config)
    one.update(points.reshape(64, 64, 3), pose)
    other.update(points, pose)
    assert_equal(one.snapshot(), other.snapshot())


def test_a_shifted_world_gives_the_shifted_map():
    """Far from the frame's origin too: 20 km away, with 3 km of height."""
    shift = np.array([20_000.0, -20_000.0, 3_000.0])
    maps = []
    for at in (np.zeros(3), shift):
        config = configured(
            domain={"xmin": float(at[0]), "ymin": float(at[1])}, lidar={"range_noise": 0.03}
        )
        rng = np.random.default_rng(13)
        position = tuple(np.array([8.0, 8.0, 500.0]) + at)
        pose = make_pose(position, pose_covariance(0.1, 1e-4))
        mapper = Mapper(config)
        x, y = scattered(rng, 0.0, 0.0, 16.0, 6000)
        local = scan(lambda x, y: 0.5 * (x > 5.1), x, y, make_pose((8.0, 8.0, 500.0)), 0.03, rng)
        mapper.update(local, pose)
        maps.append(mapper.snapshot())
    one, other = maps
    np.testing.assert_array_equal(one.level, other.level)
    np.testing.assert_allclose(other.z - shift[2], one.z, atol=1e-7)
    np.testing.assert_allclose(other.normal, one.normal, atol=1e-6)
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-4, atol=1e-9)


@pytest.mark.parametrize("factor", [0.5, 1.0, 1.15])
def test_the_noise_ratio_is_observed_over_configured(factor):
    config = configured(lidar={"range_noise": 0.05})
    rng = np.random.default_rng(15)
    mapper = Mapper(config)
    for k in range(3):
        pose = make_pose((8.0, 8.0, 500.0), stamp_ns=k)
        x, y = scattered(rng, 0.0, 0.0, 16.0, 12_000)
        report = mapper.update(scan(GROUND, x, y, pose, 0.05 * factor, rng), pose)
    # 16 cells of 750 points: a cell's deviation errs by 2.6 %, the median of 16 by under 1 %.
    assert report.noise_ratio == pytest.approx(factor, rel=0.04)


def test_the_noise_ratio_of_a_new_mapper_is_unknown():
    pose = make_pose((8.0, 8.0, 500.0))
    assert np.isnan(Mapper(configured()).update(np.zeros((0, 3)), pose).noise_ratio)


@settings(deadline=None, max_examples=120)
@given(
    st.integers(0, 10_000),
    st.sampled_from(METHODS),
    st.lists(
        st.sampled_from(["spread", "line", "one place", "wall", "few", "huge relief", "mixed"]),
        min_size=1,
        max_size=4,
    ),
)
def test_no_set_of_points_breaks_the_map(seed, method, kinds):
    fit, covariance, division = method
    rng = np.random.default_rng(seed)
    config = configured(
        domain={"min_level": 1, "max_level": 4},
        mapping={"fit": fit, "covariance": covariance, "division": division, "max_cells": 100},
    )
    mapper = Mapper(config)
    for k, kind in enumerate(kinds):
        covariance_ = EXACT if rng.random() < 0.5 else pose_covariance(0.5, 1e-3)
        pose = make_pose((8.0, 8.0, 60.0), covariance_, k)
        count = 3 if kind == "few" else 200
        x, y = scattered(rng, -1.0, -1.0, 18.0, count)
        z = 0.1 * rng.standard_normal(count)
        if kind == "line":
            y = 3.0 + 0.5 * x
        elif kind == "one place":
            x, y, z = np.full(count, x[0]), np.full(count, y[0]), np.full(count, 1.0)
        elif kind == "wall":
            x, z = np.full(count, 5.3), 20.0 * rng.random(count)
        elif kind == "huge relief":
            z = 1e3 * rng.standard_normal(count)
        elif kind == "mixed":
            z[::7], x[::3] = 30.0, x[0]
        points = (np.column_stack([x, y, z]) - pose.position) @ pose.rotation_map_lidar
        mapper.update(points, pose)
        assert_sound(mapper.snapshot())
