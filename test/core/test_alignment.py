# SPDX-License-Identifier: Apache-2.0
"""Scans that navigation puts beside the map come to lie on it; errors that are news are shared."""

from __future__ import annotations

import numpy as np
import pytest
from core.builders import (
    EXACT,
    configured,
    disturbed,
    make_pose,
    pose_covariance,
    scan,
    scattered,
)
from scipy.optimize import lsq_linear

from quadtree_lss.config.settings import MappingConfig
from quadtree_lss.core.geometry.planes import normal_from_slopes
from quadtree_lss.core.mapping.alignment import PERSISTENCE_TIME, ScanAlignment, measured_offset
from quadtree_lss.core.mapping.mapper import Mapper
from quadtree_lss.core.sensing.lidar import Pose

NOISE = 0.02
CELLS = {"min_level": 4, "max_level": 4}


def waves(x, y):
    """Ground whose slopes show every direction, wider than a cell of 1 m."""
    return 0.5 * np.sin(0.9 * x) + 0.4 * np.cos(0.8 * y + 0.3) + 0.2 * np.sin(0.6 * (x + y))


def level(x, y):
    return np.zeros_like(x)


def fly(mapper: Mapper, surface, errors, rng, covariance=None, points: int = 12000) -> None:
    """Scans straight down; the estimated pose is off the true one by each of ``errors`` (K, 3)."""
    sigma = pose_covariance(0.3, 1e-9) if covariance is None else covariance
    estimate = make_pose((8.0, 8.0, 500.0), sigma)
    for error in np.atleast_2d(errors):
        x, y = scattered(rng, 0.0, 0.0, 16.0, points)
        true = Pose(1, estimate.position - error, estimate.rotation_map_lidar, sigma)
        mapper.update(scan(surface, x, y, true, NOISE, rng), estimate)


def heights(mapper: Mapper) -> np.ndarray:
    """Elevation over the ground at the middle of the inner cells."""
    cells = mapper.snapshot()
    inner = cells.measured & (np.maximum(abs(cells.x - 8.0), abs(cells.y - 8.0)) < 7.0)
    return (cells.z - waves(cells.x, cells.y))[inner]


def mapper_of(**mapping: object) -> Mapper:
    return Mapper(configured(domain=CELLS, lidar={"range_noise": NOISE}, mapping=mapping))


def offset_of(mapper: Mapper) -> np.ndarray:
    """By how much the last scan lay off the map, n - m."""
    mean = mapper.export_state()["alignment.mean"]
    return mean[:3] - mean[3:]


def test_the_offset_is_the_weighted_least_squares_one():
    rng = np.random.default_rng(1)
    normal = normal_from_slopes(*rng.normal(0.0, 0.2, (2, 300)))
    variance = rng.uniform(0.01, 0.05, 300) ** 2
    design = normal / normal[:, 2:]
    truth = np.array([0.2, -0.3, 0.1])
    # Errors within two deviations: nothing is an outlier.
    rise = design @ truth + np.sqrt(variance) * rng.uniform(-1.0, 1.0, 300)
    rise -= design[:, :2] @ truth[:2] * 0.9
    offset, covariance = measured_offset(rise, variance, normal)
    weight = 1.0 / np.sqrt(variance)
    best = lsq_linear(design * weight[:, None], rise * weight).x
    np.testing.assert_allclose(offset, best, atol=3e-3)
    np.testing.assert_allclose(
        covariance, np.linalg.inv((design / variance[:, None]).T @ design), rtol=0.2, atol=1e-9
    )


def test_a_few_wild_cells_do_not_move_a_scan():
    rng = np.random.default_rng(2)
    normal = normal_from_slopes(*rng.normal(0.0, 0.1, (2, 200)))
    rise = rng.normal(0.0, 0.01, 200)
    rise[:20] = 5.0
    offset, _ = measured_offset(rise, np.full(200, 1e-4), normal)
    assert abs(offset[2]) < 0.01


def test_a_second_flight_comes_to_lie_on_the_first():
    rng = np.random.default_rng(3)
    error = np.array([0.2, -0.15, 0.25])
    mapper = mapper_of()
    fly(mapper, waves, np.zeros((5, 3)), rng)
    before = heights(mapper)
    fly(mapper, waves, np.tile(error, (20, 1)), rng)
    after = heights(mapper)
    # The first scan that jumps shares its height with the map: one datum for all of it.
    moved = np.median(after - before)
    assert np.std(after - before) < 0.02
    offset = offset_of(mapper)
    again = mapper.update(np.full((4, 3), np.nan), make_pose())
    assert again.offset == tuple(offset)
    np.testing.assert_allclose(offset[:2], error[:2], atol=0.08)
    assert offset[2] == pytest.approx(error[2] - moved, abs=0.03)


def test_without_alignment_it_does_not():
    rng = np.random.default_rng(3)
    mapper = mapper_of(align=False)
    fly(mapper, waves, np.zeros((5, 3)), rng)
    before = heights(mapper)
    fly(mapper, waves, np.tile([0.2, -0.15, 0.25], (20, 1)), rng)
    assert np.std(heights(mapper) - before) > 0.04


def test_switched_off_it_forgets_what_a_checkpoint_knows():
    rng = np.random.default_rng(9)
    aligned, plain = mapper_of(), mapper_of(align=False)
    fly(aligned, waves, np.zeros((3, 3)), rng)
    fly(aligned, waves, np.tile([0.0, 0.0, 0.5], (8, 1)), rng)
    assert aligned.export_state()["alignment.persistence"] > 0.5
    plain.import_state(aligned.export_state())
    before = heights(plain)
    fly(plain, waves, np.tile([0.0, 0.0, 0.5], (40, 1)), rng)
    left = float(offset_of(aligned)[2])
    assert abs(left) > 0.1
    # Nothing is taken out of the scans: in time the map comes to lie where they are.
    assert np.median(heights(plain) - before) > 0.5 * left


def test_errors_that_are_news_each_time_average():
    """White height errors: the map ends at their mean, not at the first scan's."""
    errors = np.zeros((25, 3))
    errors[:, 2] = np.random.default_rng(4).normal(0.0, 0.3, 25)
    errors[0, 2] = 0.9
    mapper = mapper_of()
    fly(mapper, level, errors, np.random.default_rng(5))
    cells = mapper.snapshot()
    assert np.std(cells.z[cells.measured]) < 0.01
    assert np.median(cells.z) == pytest.approx(errors[:, 2].mean(), abs=0.05)


def test_new_ground_joins_at_the_height_of_the_old():
    """A scan that sees half of the map again: both halves are level in the end."""
    rng = np.random.default_rng(6)
    mapper = mapper_of()
    sigma = pose_covariance(0.3, 1e-9)
    for error, low in ((0.0, 0.0), (0.4, 6.0)):
        estimate = make_pose((8.0, 8.0, 500.0), sigma)
        x = low + 10.0 * rng.random(12000)
        y = 16.0 * rng.random(12000)
        true = Pose(1, estimate.position - (0, 0, error), estimate.rotation_map_lidar, sigma)
        mapper.update(scan(level, x, y, true, NOISE, rng), estimate)
    cells = mapper.snapshot()
    assert cells.measured.all()
    assert np.ptp(cells.z) < 0.05
    assert np.median(cells.z) == pytest.approx(0.2, abs=0.02)


def test_exact_poses_are_left_alone():
    rng = np.random.default_rng(7)
    mapper = mapper_of()
    fly(mapper, waves, np.zeros((3, 3)), rng, EXACT)
    fly(mapper, waves, np.tile([0.0, 0.0, 0.3], (3, 1)), rng, EXACT)
    np.testing.assert_allclose(offset_of(mapper), 0.0, atol=1e-4)


def test_level_ground_tells_nothing_sideways():
    rng = np.random.default_rng(8)
    mapper = mapper_of()
    fly(mapper, level, np.zeros((3, 3)), rng)
    fly(mapper, level, np.tile([0.3, 0.3, 0.2], (10, 1)), rng)
    offset = offset_of(mapper)
    assert np.abs(offset[:2]).max() < 0.1
    assert np.ptp(mapper.snapshot().z) < 0.05


def tilted(angle: float) -> np.ndarray:
    """rotation_map_lidar of a lidar that looks ``angle`` off nadir, towards map x."""
    back = np.array([np.sin(angle), 0.0, -np.cos(angle)])
    return np.column_stack([np.cross([0.0, -1.0, 0.0], back), [0.0, -1.0, 0.0], back])


@pytest.mark.parametrize("persistent", [False, True])
@pytest.mark.parametrize(("position_sigma", "attitude_sigma"), [(0.05, 2e-5), (0.05, 1e-3)])
def test_off_nadir_the_offset_stays_within_the_pose_error(
    position_sigma, attitude_sigma, persistent
):
    """From 30 degrees aside attitude makes x and z err together; every scan keeps its points."""
    rng = np.random.default_rng(10)
    sigma = pose_covariance(position_sigma, attitude_sigma)
    angle = np.radians(30.0)
    place = (8.0 - 400.0 * np.tan(angle), 8.0, 400.0)
    mapper = mapper_of()
    bound = 5.0 * np.hypot(position_sigma, attitude_sigma * 400.0 / np.cos(angle))
    error = make_pose(place, sigma, rotation=tilted(angle))
    error = disturbed(error, rng)
    for k in range(100):
        true = make_pose(place, sigma, 1_000_000_000 + 50_000_000 * k, tilted(angle))
        drawn = disturbed(true, rng)
        if persistent:
            drawn = Pose(true.stamp_ns, error.position, error.rotation_map_lidar, sigma)
        x, y = scattered(rng, 2.0, 2.0, 12.0, 3000)
        report = mapper.update(scan(waves, x, y, true, NOISE, rng), drawn)
        assert report.points_used > 2500
        assert np.abs(offset_of(mapper)).max() < bound
        covariance = mapper.export_state()["alignment.covariance"]
        assert np.linalg.eigvalsh(covariance).min() > -1e-12


@pytest.mark.parametrize("sigma", [0.05, 0.2])
@pytest.mark.parametrize("persistent", [False, True])
def test_the_maps_height_is_as_well_known_as_it_says(sigma, persistent):
    """Errors that are news each time and errors that last, over eight flights each."""
    squares = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        errors = np.zeros((60, 3))
        errors[:, 2] = rng.normal(0.0, sigma, 1 if persistent else 60)
        mapper = mapper_of()
        fly(mapper, level, errors, rng, pose_covariance(sigma, 1e-9), points=1500)
        cells = mapper.snapshot()
        # The estimated pose is too high by the error, and so is the ground.
        middle = np.flatnonzero(cells.measured)
        height = np.median(cells.z[middle])
        squares.append(height**2 / np.median(cells.covariance_pose[middle, 2, 2]))
    assert 0.02 < np.mean(squares) < 2.0


def test_errors_that_persist_leave_the_height_uncertain():
    """A hundred scans of one bias tell no more of absolute height than the first."""
    rng = np.random.default_rng(11)
    mapper = mapper_of()
    fly(mapper, level, np.tile([0.0, 0.0, 0.3], (100, 1)), rng, points=3000)
    cells = mapper.snapshot()
    claimed = np.sqrt(cells.covariance_pose[cells.measured, 2, 2])
    assert np.median(claimed) > 0.15


def test_a_glitch_that_no_covariance_explains_stays_out_of_the_map():
    """Five scans 3 m too high whose poses claim 5 cm, among scans that are right."""
    rng = np.random.default_rng(12)
    mapper = mapper_of()
    sigma = pose_covariance(0.05, 1e-9)
    fly(mapper, waves, np.zeros((10, 3)), rng, sigma)
    fly(mapper, waves, np.tile([0.0, 0.0, 3.0], (5, 1)), rng, sigma)
    fly(mapper, waves, np.zeros((20, 3)), rng, sigma)
    assert abs(np.median(heights(mapper))) < 0.1
    assert np.std(heights(mapper)) < 0.03


def test_without_news_an_error_is_forgotten():
    """Scans of other ground: what was known decays to what the pose claims."""
    alignment = ScanAlignment(MappingConfig())
    claim = np.diag([0.04, 0.04, 0.09])
    none = np.empty(0), np.empty(0), np.empty((0, 3))
    level_ground = np.zeros(50), np.full(50, 1e-4), np.tile([0.0, 0.0, 1.0], (50, 1))
    rise = (level_ground[0] + 0.2, *level_ground[1:])
    alignment.predicted(make_pose(stamp_ns=0))
    alignment.meet(*none, claim)
    for k in range(1, 30):
        alignment.predicted(make_pose(stamp_ns=k * 50_000_000))
        alignment.meet(*rise, claim)
    known = alignment.mean[2]
    assert alignment.covariance[2, 2] < 0.6 * claim[2, 2]
    later = round((1.0 + PERSISTENCE_TIME) * 1e9)
    alignment.predicted(make_pose(stamp_ns=later))
    alignment.meet(*none, claim)
    assert abs(alignment.mean[2]) < 0.5 * abs(known)
    assert alignment.covariance[2, 2] > 0.8 * claim[2, 2]
