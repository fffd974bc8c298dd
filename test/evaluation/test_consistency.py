# SPDX-License-Identifier: Apache-2.0
"""Prefit residuals: their distribution by Monte Carlo, their formula by its definition."""

import sys
from pathlib import Path

import numpy as np
import pytest
from core.builders import (
    EXACT,
    configured,
    disturbed,
    flat,
    make_pose,
    point_covariances,
    pose_covariance,
    random_covariances,
    scan,
    scattered,
    slope,
)
from core.kernels import tangent_basis
from scipy.special import gammainc

from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing import lidar
from quadtree_lss.onboard.core.sensing.register import RegisteredScan, register

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmark"))

from common.consistency import HIGH, LOW, Counts, prefit_statistics

GROUND = slope(0.12, -0.07, 30.0)
NOISE = 0.05
LIDAR = configured(lidar={"range_noise": NOISE}).lidar


def registered(mapper: Mapper, points: np.ndarray, pose: lidar.Pose) -> RegisteredScan:
    return register(points, pose, mapper.config.lidar, mapper.domain)[0]


def one_more_scan(
    true: np.ndarray, claimed: np.ndarray, trials: int, treatment: str = "none"
) -> Counts:
    """Maps of two scans of planar ground, each compared with a third scan of it."""
    config = configured(
        domain={"min_level": 1, "max_level": 1},
        lidar={"range_noise": NOISE},
        mapping={"paper": treatment},
        pose={"correlation_time": 0.0},
    )
    rng = np.random.default_rng(1)
    counts = Counts()
    for _ in range(trials):
        mapper = Mapper(config)
        for k in range(3):
            pose = make_pose((60.0, -40.0 + 30.0 * k, 300.0), true, k)
            x, y = scattered(rng, -1.0, -1.0, 18.0, 500)
            points = scan(GROUND, x, y, disturbed(pose, rng), NOISE, rng)
            pose = make_pose((60.0, -40.0 + 30.0 * k, 300.0), claimed, k)
            if k == 2:
                counts += prefit_statistics(
                    mapper.snapshot(), registered(mapper, points, pose), config.lidar
                ).counts()
            mapper.update(points, pose)
    return counts


def test_interval_holds_95_per_cent():
    half_squares = 0.5 * np.square([LOW, HIGH])
    assert gammainc(0.5, half_squares) == pytest.approx([0.025, 0.975])


@pytest.mark.parametrize(
    ("covariance", "trials"),
    [(EXACT, 40), (pose_covariance(0.2, 3e-4), 250)],
    ids=["range noise", "pose and range noise"],
)
def test_residuals_of_a_sound_map_are_consistent(covariance, trials):
    """Pose error is common to a scan, so a trial is hardly more than one draw of it."""
    counts = one_more_scan(covariance, covariance, trials)
    draws = trials if covariance[0, 0] > 1e-6 else counts.points
    tolerance = 5.0 * np.sqrt(0.025 * 0.975 / draws)
    assert counts.points > 300 * trials
    assert counts.shares == pytest.approx((0.025, 0.025), abs=tolerance)


def test_too_small_a_pose_covariance_shows_above_and_too_large_a_one_below():
    true, small, large = (pose_covariance(s, 1e-5) for s in (0.5, 0.1, 2.5))
    assert one_more_scan(true, small, 60).shares[1] > 0.3
    assert one_more_scan(true, large, 60).shares[0] > 0.06


def test_treating_pose_error_as_independent_is_inconsistent():
    """The leaf then believes that a thousand points average its pose error out."""
    pose = pose_covariance(0.3, 1e-5)
    common = one_more_scan(pose, pose, 150)
    independent = one_more_scan(pose, pose, 150, "covariance")
    assert independent.shares[1] > 1.5 * common.shares[1]


def test_statistics_are_those_of_equations_17_and_61():
    """Each point, with a full pose covariance."""
    rng = np.random.default_rng(3)
    covariance = random_covariances(rng, 1, 6, 0.02)[0]
    mapper = Mapper(configured(domain={"min_level": 2, "max_level": 2}))
    pose = make_pose((20.0, -10.0, 150.0), covariance)
    x, y = scattered(rng, 0.0, 0.0, 16.0, 800)
    mapper.update(scan(GROUND, x, y, pose, NOISE, rng), pose)
    x, y = scattered(rng, 0.0, 0.0, 16.0, 50)
    seen = registered(mapper, scan(GROUND, x, y, pose, NOISE, rng), pose)
    cells = mapper.snapshot()
    found = prefit_statistics(cells, seen, LIDAR)
    for k, (i, row) in enumerate(zip(found.point, found.row, strict=True)):
        n = cells.normal[row]
        arm = seen.pose.position + seen.points[i] - (cells.x[row], cells.y[row], cells.z[row])
        residual = n @ arm
        (sigma,) = point_covariances(seen.points[i : i + 1] + seen.pose.position, pose, NOISE)
        a = np.r_[tangent_basis(n).T @ arm, -1.0]
        plane = cells.covariance[row]
        assert found.residual[k] == pytest.approx(residual)
        assert found.sigma[k] ** 2 == pytest.approx(n @ sigma @ n + a @ plane @ a)


def test_only_points_of_measured_leaves_are_compared():
    """The map is not changed, and empty or inherited leaves say nothing."""
    mapper = Mapper(configured(domain={"min_level": 2, "max_level": 2}))
    pose = make_pose()
    rng = np.random.default_rng(4)
    x, y = scattered(rng, 0.0, 0.0, 16.0, 600)
    everywhere = registered(mapper, scan(flat(), x, y, pose, NOISE, rng), pose)
    nothing = prefit_statistics(mapper.snapshot(), everywhere, LIDAR)
    assert len(nothing.residual) == 0
    assert nothing.counts() == Counts()
    assert np.isnan(nothing.counts().shares).all()
    half = x < 8.0
    mapper.update(scan(flat(), x[half], y[half], pose, NOISE, rng), pose)
    cells = mapper.snapshot()
    before = cells.z.copy()
    found = prefit_statistics(cells, everywhere, LIDAR)
    assert cells.measured[found.row].all()
    assert (everywhere.points[found.point, 0] + everywhere.pose.position[0] < 8.0).all()
    assert len(found.residual) == np.count_nonzero(half)
    np.testing.assert_array_equal(cells.z, before)
