# SPDX-License-Identifier: Apache-2.0
"""Measurement model: Eq. 14, 15, 17 and the two conventions of attitude error (Eq. 16, ROS)."""

from __future__ import annotations

import numpy as np
import pytest
from core.builders import (
    configured,
    domain_of,
    flat,
    lattice,
    make_pose,
    random_covariances,
    scan,
)
from scipy.spatial.transform import Rotation

from quadtree_lss.core.geometry import rotations
from quadtree_lss.core.mapping.mapper import Mapper
from quadtree_lss.core.mapping.update import ScanUpdate
from quadtree_lss.core.sensing import lidar
from quadtree_lss.core.sensing.register import register

DRAWS = 40_000
#: A sample (co)variance of DRAWS normal values errs by sqrt(2 / DRAWS) = 0.7 % (one sigma).
MONTE_CARLO = 5.0 * np.sqrt(2.0 / DRAWS)


def assert_covariance(samples: np.ndarray, expected: np.ndarray) -> None:
    """Entry ij of a sample covariance errs in proportion to sqrt(C_ii C_jj)."""
    found = np.cov(samples.T)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert (np.abs(found - expected) <= MONTE_CARLO * scale + 1e-15).all()


def test_axes_of_equation_14():
    """z boresight, x right for positive azimuth, y down for negative elevation."""
    boresight, right, up = lidar.points_from_ranges(
        [10.0, 10.0, 10.0], [0.0, 0.5 * np.pi, 0.0], [0.0, 0.0, 0.5 * np.pi]
    )
    np.testing.assert_allclose(boresight, [0.0, 0.0, 10.0], atol=1e-12)
    np.testing.assert_allclose(right, [10.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(up, [0.0, -10.0, 0.0], atol=1e-12)


def test_angles_and_range_come_back_from_the_point():
    rng = np.random.default_rng(1)
    rho = rng.uniform(1.0, 500.0, (8, 5))
    azimuth, elevation = rng.uniform(-1.2, 1.2, (2, 8, 5))
    p = lidar.points_from_ranges(rho, azimuth, elevation)
    assert p.shape == (8, 5, 3)
    np.testing.assert_allclose(np.linalg.norm(p, axis=-1), rho, rtol=1e-12)
    np.testing.assert_allclose(np.arctan2(p[..., 0], p[..., 2]), azimuth, atol=1e-12)
    np.testing.assert_allclose(np.arcsin(-p[..., 1] / rho), elevation, atol=1e-12)


@pytest.mark.parametrize("count", [1, 7, 30, 64])
def test_registered_points_are_those_of_equation_15(count):
    """In any order, each in the finest cell under it."""
    rotation = Rotation.from_euler("xyz", [2.6, -0.2, 1.0]).as_matrix()
    pose = make_pose((8.0, 7.0, 120.0), rotation=rotation)
    config = configured()
    domain = domain_of(config)
    expected = np.random.default_rng(2).uniform(0.0, 16.0, (count, 3))
    points = (expected - pose.position) @ rotation
    found, dropped = register(points, pose, config.lidar, domain)
    assert sum(dropped.values()) == 0
    order = np.lexsort(found.points)
    np.testing.assert_allclose(found.points.T[order], expected[np.lexsort(expected.T)], atol=1e-9)
    column, row = (expected[np.lexsort(expected.T), :2] / domain.finest_size).astype(int).T
    np.testing.assert_array_equal(found.finest[order], row * domain.finest_count + column)


@pytest.mark.parametrize("convention", ["fixed axes with cross block", "lidar axes (Eq. 16)"])
def test_point_covariance_against_monte_carlo(convention):
    rng = np.random.default_rng(3)
    rotation = Rotation.from_euler("xyz", [2.6, 0.3, -0.8]).as_matrix()
    point = np.array([3.0, -8.0, 60.0])
    position = np.array([20.0, -10.0, 55.0])
    # Small angles: the second order, |r| sigma^2 / 2 = 3e-5 m, is far below |r| sigma.
    if convention.startswith("fixed"):
        covariance = random_covariances(rng, 1, 6, 1.0)[0]
        scale = np.diag([0.2] * 3 + [1e-3] * 3)
        covariance = scale @ covariance @ scale
        error = rng.multivariate_normal(np.zeros(6), covariance, DRAWS)
        turned = rotations.exp(error[:, 3:]) @ rotation
    else:
        of_position = 0.04 * random_covariances(rng, 1, 3, 1.0)[0]
        of_attitude = 1e-6 * random_covariances(rng, 1, 3, 1.0)[0]
        covariance = lidar.fixed_from_body_covariance(of_position, of_attitude, rotation)
        error = np.hstack(
            [
                rng.multivariate_normal(np.zeros(3), of_position, DRAWS),
                rng.multivariate_normal(np.zeros(3), of_attitude, DRAWS),
            ]
        )
        turned = rotation @ rotations.exp(error[:, 3:])
    noise = 0.1
    measured = point * (1.0 + noise * rng.standard_normal(DRAWS) / np.linalg.norm(point))[:, None]
    samples = (turned @ measured[:, :, None])[:, :, 0] + position + error[:, :3]
    pose = make_pose(tuple(position), covariance, rotation=rotation)
    mean = (rotation @ point + position)[None]
    assert_covariance(samples, lidar.point_covariances(mean, pose, noise)[0])


def test_covariance_of_a_scans_ground_is_that_of_a_point_in_its_middle():
    root = np.random.default_rng(6).normal(0.0, 1e-2, (6, 6))
    pose = make_pose((80.0, -50.0, 300.0), root @ root.T)
    mapper = Mapper(configured())
    x, y = lattice(0.0, 0.0, 16.0, 20)
    seen, _ = register(scan(flat(), x, y, pose, 0.0), pose, mapper.config.lidar, mapper.domain)
    change = ScanUpdate(mapper.leaves, mapper._stored, mapper._alignment, mapper.config, seen)
    expected = lidar.point_covariances(change.origin[None], seen.pose, 0.0)[0]
    np.testing.assert_allclose(change._ground_covariance(), expected, rtol=1e-9)


def test_body_and_fixed_covariance_are_inverse():
    rng = np.random.default_rng(4)
    rotation = Rotation.from_euler("xyz", [1.0, 0.3, -0.8]).as_matrix()
    of_position, of_attitude = random_covariances(rng, 2, 3, 0.1)
    fixed = lidar.fixed_from_body_covariance(of_position, of_attitude, rotation)
    body = lidar.body_from_fixed_covariance(fixed, rotation)
    np.testing.assert_allclose(body[:3, :3], of_position, atol=1e-15)
    np.testing.assert_allclose(body[3:, 3:], of_attitude, atol=1e-15)
    np.testing.assert_allclose(body[:3, 3:], 0.0, atol=1e-15)


def test_cross_block_turns_with_the_axes():
    """Sigma_m,body = Sigma_m,fixed R, so that both describe the same joint error."""
    rng = np.random.default_rng(5)
    rotation = Rotation.from_euler("xyz", [1.0, 0.3, -0.8]).as_matrix()
    fixed = random_covariances(rng, 1, 6, 0.1)[0]
    body = lidar.body_from_fixed_covariance(fixed, rotation)
    np.testing.assert_allclose(body[:3, 3:], fixed[:3, 3:] @ rotation, atol=1e-15)
    np.testing.assert_allclose(body[3:, 3:], rotation.T @ fixed[3:, 3:] @ rotation, atol=1e-15)


def organised(height: int = 12, width: int = 16) -> np.ndarray:
    azimuth, elevation = np.meshgrid(
        np.linspace(-0.01, 0.01, width), np.linspace(-0.01, 0.01, height)
    )
    return lidar.points_from_ranges(np.full((height, width), 400.0), azimuth, elevation)


def isolated(points: np.ndarray, gate: float = 0.4) -> np.ndarray:
    ranges = np.linalg.norm(points, axis=-1)
    rows = points.reshape(-1, 3).T
    return lidar.isolated_returns(rows, np.isfinite(ranges), ranges, gate)


@pytest.mark.parametrize("where", [(5, 5), (0, 0), (11, 15), (0, 7)])
@pytest.mark.parametrize("form", ["organised", "unorganised"])
def test_a_lonely_return_is_found_and_only_it(where, form):
    points = organised()
    points[where] *= 1.0 + 30.0 / 400.0
    expected = np.zeros(points.shape[:2], dtype=bool)
    expected[where] = True
    if form == "unorganised":
        points, expected = points.reshape(-1, 3), expected.ravel()
    np.testing.assert_array_equal(isolated(points), expected)


def test_slanted_ground_has_no_lonely_returns():
    """Neighbours differ by 2 m in range there, more than the gate."""
    points = organised()
    points *= (1.0 + 2.0 * np.arange(12)[:, None] / 400.0)[:, :, None]
    assert not isolated(points).any()


def test_missing_returns_are_no_neighbours_and_not_flagged():
    points = organised()
    points[3:6, 3:6] = np.nan
    points[4, 4] = organised()[4, 4]
    expected = np.zeros(points.shape[:2], dtype=bool)
    expected[4, 4] = True
    np.testing.assert_array_equal(isolated(points), expected)


@pytest.mark.parametrize("returns", [0, 1])
def test_too_few_returns_are_not_judged(returns):
    points = np.full((4, 4, 3), np.nan)
    points.reshape(-1, 3)[:returns] = (0.0, 0.0, 10.0)
    assert not isolated(points).any()


def test_gate_zero_keeps_all():
    points = organised()
    points[5, 5] *= 2.0
    assert not isolated(points, gate=0.0).any()
