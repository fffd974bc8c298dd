# SPDX-License-Identifier: Apache-2.0
"""Scans that navigation puts beside the map come to lie on it; errors that are news are shared."""

from __future__ import annotations

import numpy as np
import pytest
from core.builders import EXACT, configured, make_pose, pose_covariance, scan, scattered
from scipy.optimize import lsq_linear

from quadtree_lss.core.alignment import measured_offset
from quadtree_lss.core.lidar import Pose
from quadtree_lss.core.mapping import Mapper
from quadtree_lss.core.planes import normal_from_slopes

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
    state = mapper.export_state()
    np.testing.assert_allclose(state["alignment.offset"][:2], error[:2], atol=0.06)
    assert state["alignment.offset"][2] == pytest.approx(error[2] - moved, abs=0.02)


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
    assert aligned.export_state()["alignment.persists"]
    plain.import_state(aligned.export_state())
    before = heights(plain)
    fly(plain, waves, np.tile([0.0, 0.0, 0.5], (40, 1)), rng)
    left = float(aligned.export_state()["alignment.offset"][2])
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
    np.testing.assert_allclose(mapper.export_state()["alignment.offset"], 0.0, atol=1e-4)


def test_level_ground_tells_nothing_sideways():
    rng = np.random.default_rng(8)
    mapper = mapper_of()
    fly(mapper, level, np.zeros((3, 3)), rng)
    fly(mapper, level, np.tile([0.3, 0.3, 0.2], (10, 1)), rng)
    offset = mapper.export_state()["alignment.offset"]
    assert np.abs(offset[:2]).max() < 0.1
    assert np.ptp(mapper.snapshot().z) < 0.05
