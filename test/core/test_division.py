# SPDX-License-Identifier: Apache-2.0
"""Division statistics against their expectations on planar ground."""

from __future__ import annotations

import numpy as np
import pytest
from core.builders import (
    configured,
    flat,
    four_leaves,
    make_pose,
    mapped,
    pose_covariance,
    scan,
    scattered,
    unit_vectors,
    upward_normals,
)

from quadtree_lss.config.settings import MappingConfig
from quadtree_lss.core.mapping import division
from quadtree_lss.core.sensing.lidar import point_covariances

DRAWS = 4000


def test_expectations_are_those_of_chi_distributions():
    draws = np.random.default_rng(1).standard_normal((400_000, 3))
    # A mean of 400,000 draws errs by 0.1 %.
    one = np.abs(draws[:, 0]).mean()
    three = np.linalg.norm(draws, axis=1).mean()
    assert division.MEAN_CHI_1 == pytest.approx(one, rel=5e-3)
    assert division.MEAN_CHI_3 == pytest.approx(three, rel=5e-3)


@pytest.mark.parametrize("count", [8, 12, 40])
def test_lack_of_fit_is_one_whatever_the_number_of_points(count):
    """Three degrees of freedom go into the plane: sqrt(N / (N - 3)) makes up for them.

    To first order; the points' unequal leverage leaves about 1 / N^2 of relative error.
    """
    rng = np.random.default_rng(2)
    xy = rng.uniform(-1.0, 1.0, (DRAWS, count, 2))
    rows = np.concatenate([np.ones((DRAWS, count, 1)), xy], axis=2)
    z = 0.1 * rng.standard_normal((DRAWS, count))
    fit = np.linalg.solve(rows.transpose(0, 2, 1) @ rows, (rows.transpose(0, 2, 1) @ z[:, :, None]))
    residual = np.abs(z - (rows @ fit)[:, :, 0]).mean(axis=1)
    noise, number = np.full(DRAWS, 0.1), np.full(DRAWS, float(count))
    mean = division.lack_of_fit(residual, noise, number).mean()
    error = 5.0 * 0.75 / np.sqrt(DRAWS * count) + 3.0 / count**2
    assert mean == pytest.approx(division.MEAN_CHI_1, rel=error)


@pytest.mark.parametrize("count", [1.0, 2.0, 3.0])
def test_three_points_say_nothing_of_a_fit(count):
    assert division.lack_of_fit(np.array([9.0]), np.array([1.0]), np.array([count]))[0] == 0.0


def test_mahalanobis_factor_is_the_distance_of_equation_46():
    """sqrt((r_hat - r)^T Sigma^-1 (r_hat - r)) with both on one ray and Eq. 61's Sigma."""
    rng = np.random.default_rng(3)
    normal = upward_normals(rng, 20)
    pose = make_pose((30.0, 20.0, 90.0), pose_covariance(0.3, 1e-3))
    points = rng.uniform(-5.0, 5.0, (20, 3))
    ray = points - pose.position
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    sigma = point_covariances(points, pose, 0.05)
    variance = rng.uniform(0.0, 0.01, 20)
    found = division.mahalanobis_factor(normal, ray, sigma, variance)
    for k in range(20):
        epsilon = 0.07
        along = normal[k] @ ray[k]
        apart = epsilon * ray[k] / along
        full = sigma[k] + variance[k] * np.outer(ray[k], ray[k]) / along**2
        expected = np.sqrt(apart @ np.linalg.solve(full, apart))
        assert found[k] * epsilon == pytest.approx(expected, rel=1e-6)


def test_the_prefit_residual_has_one_degree_of_freedom():
    """Erratum of Eq. 46: E[d_M] = 0.80 sqrt(u' Sigma^-1 u . n' Sigma n) / |n.u|, not 1.60."""
    rng = np.random.default_rng(4)
    normal, ray = upward_normals(rng, 1)[0], -np.abs(unit_vectors(rng, 1)[0])
    pose = make_pose(tuple(-100.0 * ray), pose_covariance(0.2, 1e-3))
    sigma = point_covariances(np.zeros((1, 3)), pose, 0.1)[0]
    errors = rng.multivariate_normal(np.zeros(3), sigma, 50_000)
    factor = division.mahalanobis_factor(normal[None], ray[None], sigma[None], np.zeros(1))[0]
    mean = np.mean(np.abs(errors @ normal)) * factor
    u, n = ray, normal
    product = (u @ np.linalg.solve(sigma, u)) * (n @ sigma @ n)
    expected = division.MEAN_CHI_1 * np.sqrt(product) / abs(n @ u)
    assert mean == pytest.approx(expected, rel=0.02)


def test_distances_are_along_the_normal():
    rng = np.random.default_rng(5)
    normal, through = upward_normals(rng, 3), rng.standard_normal((3, 3))
    group, points = rng.integers(0, 3, 40), rng.standard_normal((3, 40))
    found = division.distances(normal, through, group, points)
    for k in range(40):
        expected = normal[group[k]] @ (points[:, k] - through[group[k]])
        assert found[k] == pytest.approx(expected, abs=1e-12)


def test_a_scan_weighs_by_the_residuals_its_fit_left_free():
    """Its points less three; from `division_min_residuals` of them on the leaf asks."""
    config = MappingConfig(division_confidence=0.0, division_min_residuals=8)
    rows, fitted = np.arange(4), np.zeros(4)
    leaves = four_leaves()
    for count, statistic in ((4.0, 9.0), (12.0, 0.5)):
        division.asks(leaves, rows, np.full(4, statistic), np.full(4, count), fitted, config)
    np.testing.assert_allclose(leaves.division_weight[rows], 1.0 + 9.0)
    np.testing.assert_allclose(leaves.division_sum[rows], 9.0 + 4.5)
    few = four_leaves()
    for asked in (False, True):  # four free residuals, then eight
        found = division.asks(few, rows, np.full(4, 9.0), np.full(4, 7.0), fitted, config)
        assert found.tolist() == [asked] * 4


def test_the_papers_criterion_judges_known_cells_by_the_plane_they_had():
    """Its residuals are prefit ones: level ground that rose does not fit its leaf."""
    config = configured(
        domain={"min_level": 2, "max_level": 3},
        mapping={"division": "mahalanobis", "align": False},
        lidar={"range_noise": 0.02},
    )
    mapper = mapped(config, flat(), density=20.0, scans=1)
    assert mapper.leaves.count == 16
    rng, pose = np.random.default_rng(2), make_pose((8.0, 8.0, 500.0))
    x, y = scattered(rng, 0.0, 0.0, 16.0, 5000)
    mapper.update(scan(flat(0.5), x, y, pose, 0.02, rng), pose)
    assert mapper.leaves.count > 16
