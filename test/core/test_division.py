# SPDX-License-Identifier: Apache-2.0
"""Division statistics against their expectations on planar ground, and who may judge a leaf."""

import numpy as np
import pytest
from core.builders import configured, look, mapped, point_covariances
from core.kernels import division, tangent_basis
from core.scenes import make_pose, pose_covariance, scan, slope
from scipy.stats import halfnorm

from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.mapping.measure import Rules

MEAN_CHI_1 = np.sqrt(2.0 / np.pi)


@pytest.mark.parametrize("per_cell", [12, 40])
def test_the_statistic_is_that_of_noise_whatever_the_number_of_points(per_cell):
    """Three degrees of freedom go into the plane: sqrt(N / (N - 3)) makes up for them."""
    config = configured(levels=(4, 4), noise=0.05)
    leaves = mapped(config, slope(0.1, -0.2), density=per_cell, scans=8).leaves.rows
    mean = leaves.division_sum.sum() / leaves.division_weight.sum()
    assert mean == pytest.approx(MEAN_CHI_1, rel=0.02 + 3.0 / per_cell**2)


def test_a_known_cells_statistic_is_that_of_equations_46_and_47(monkeypatch):
    """The mean distance to the plane that it had, over what map and points may be off there."""
    of = {"domain": {"size": 8.0}, "mapping": {"paper": "division"}}
    config = configured(levels=(0, 1), noise=0.02, **of)
    mapper, rng = Mapper(config), np.random.default_rng(6)
    monkeypatch.setattr(mapper, "_align", lambda *_: 0.0)
    pose = make_pose((40.0, -20.0, 90.0), pose_covariance(0.05, 1e-3), 10**9)
    ground = slope(0.2, -0.1)
    look(mapper, ground, *(5.0 * rng.random((2, 60))), rng, 0.02, pose)
    before = mapper.leaves.rows[0].copy()
    x, y = 3.0 + 5.0 * rng.random((2, 400))
    later = make_pose((40.0, -20.0, 90.0), pose.covariance, 10**11)
    points = scan(ground, x, y, later, 0.02, rng)
    mapper.update(points, later)
    leaf, seen = mapper.leaves.rows[0], points @ later.rotation_map_lidar.T
    n, middle = before.normal, np.array([before.x, before.y, before.z]) - later.position
    a = np.append(tangent_basis(n).T @ (seen.mean(axis=0) - middle), -1.0)
    plane = a @ (before.range_part + before.pose_part).reshape(3, 3) @ a
    # Of a point where they are on average: Eq. 61's Sigma, both places on one ray.
    point, ray = seen.mean(axis=0), seen.mean(axis=0) / np.linalg.norm(seen.mean(axis=0))
    total = point_covariances((point + later.position)[None], later, 0.02)[0]
    total += plane * np.outer(ray, ray) / (n @ ray) ** 2
    apart = np.abs((seen - middle) @ n).mean() * ray / (n @ ray)
    added = leaf.division_sum - before.division_sum
    expected = np.sqrt(apart @ np.linalg.solve(total, apart))
    assert added / len(points) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("deviations", "rough"), [(1.9, False), (2.1, True)])
@pytest.mark.parametrize("count", [10, 100, 1000])
def test_a_leaf_is_rough_by_two_deviations_of_the_mean_residual(count, deviations, rough):
    """Beyond the division factor; |N(0, 1)| is a half-normal variable."""
    rules, leaf = Rules(configured()), Mapper(configured(levels=(1, 3))).leaves.rows[0:1]
    mean, spread = halfnorm.mean(), halfnorm.std() / np.sqrt(count)
    leaf.residuals, leaf.noise_sum = count, count * 0.05 * mean
    leaf.distance_sum = count * 0.05 * (rules.division_factor * mean + deviations * spread)
    assert division.residuals_divide(rules, leaf) == rough
