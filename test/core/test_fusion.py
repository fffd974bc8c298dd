# SPDX-License-Identifier: Apache-2.0
"""Fusion of two planes (Eq. 39-45) and of a plane with a height."""

from __future__ import annotations

import numpy as np
from core.builders import random_covariances, transported, upward_normals

from quadtree_lss.core.geometry import fusion, sphere
from quadtree_lss.core.geometry.fusion import Planes

UP = np.array([0.0, 0.0, 1.0])
DRAWS = 20_000
MONTE_CARLO = 5.0 * np.sqrt(2.0 / DRAWS)


def total(of: Planes) -> np.ndarray:
    return of.range_part + of.pose_part


def estimates(rng: np.random.Generator, truth: np.ndarray, d: np.ndarray, scale: float) -> Planes:
    """One estimate of each true plane, drawn from random covariances of two parts."""
    count = len(d)
    range_part = random_covariances(rng, count, 3, scale)
    pose_part = random_covariances(rng, count, 3, scale)
    root = np.linalg.cholesky(range_part + pose_part)
    error = (root @ rng.standard_normal((count, 3, 1)))[:, :, 0]
    return Planes.of(sphere.plus(truth, error[:, :2]), d + error[:, 2], range_part, pose_part)


def pair(scale: float, seed: int = 1, count: int = 50) -> tuple[Planes, Planes]:
    rng = np.random.default_rng(seed)
    truth, d = upward_normals(rng, count), rng.standard_normal(count)
    return estimates(rng, truth, d, scale), estimates(rng, truth, d, scale)


def test_order_does_not_matter_to_first_order():
    """The plane differs by the square of the disagreement, the covariance by its first power."""
    for scale in (1e-2, 1e-3, 1e-4):
        a, b = pair(scale)
        one, other = fusion.fuse_pair(a, b), fusion.fuse_pair(b, a)
        apart = np.linalg.norm(sphere.minus(a.normal, b.normal), axis=1).max()
        assert np.linalg.norm(sphere.minus(one.normal, other.normal), axis=1).max() < 2.0 * apart**2
        np.testing.assert_allclose(one.d, other.d, atol=2.0 * apart**2)
        moved = transported(total(other), other.normal, one.normal)
        size = np.abs(total(one)).max(axis=(1, 2), keepdims=True)
        assert (np.abs(moved - total(one)) / size).max() < 5.0 * apart


def test_information_adds():
    a, b = pair(1e-4)
    fused = fusion.fuse_pair(a, b)
    seen = transported(total(b), b.normal, a.normal)
    expected = np.linalg.inv(np.linalg.inv(total(a)) + np.linalg.inv(seen))
    np.testing.assert_allclose(total(fused), expected, rtol=1e-6, atol=1e-15)


def test_fused_plane_is_the_weighted_mean():
    """Against the two-observation least squares of Eq. 40-42, both in the first one's tangent."""
    a, b = pair(1e-3, seed=2)
    fused = fusion.fuse_pair(a, b)
    seen = transported(total(b), b.normal, a.normal)
    for k in range(len(a.d)):
        weight = np.linalg.inv(np.stack([total(a)[k], seen[k]]))
        error = np.append(sphere.minus(b.normal[k], a.normal[k]), b.d[k] - a.d[k])
        step = np.linalg.solve(weight.sum(axis=0), weight[1] @ error)
        np.testing.assert_allclose(sphere.minus(fused.normal[k], a.normal[k]), step[:2], atol=1e-9)
        assert abs(fused.d[k] - a.d[k] - step[2]) < 1e-9


def test_covariance_against_monte_carlo():
    """Errors of fused planes about the truth follow the covariance that is told."""
    rng = np.random.default_rng(3)
    truth, d = np.tile(upward_normals(rng, 1), (DRAWS, 1)), np.full(DRAWS, 0.4)
    parts = random_covariances(rng, 4, 3, 2e-3)

    def drawn(range_part: np.ndarray, pose_part: np.ndarray) -> Planes:
        error = rng.multivariate_normal(np.zeros(3), range_part + pose_part, DRAWS)
        tile = (DRAWS, 1, 1)
        return Planes.of(
            sphere.plus(truth, error[:, :2]),
            d + error[:, 2],
            np.tile(range_part, tile),
            np.tile(pose_part, tile),
        )

    fused = fusion.fuse_pair(drawn(parts[0], parts[1]), drawn(parts[2], parts[3]))
    error = np.column_stack([sphere.minus(fused.normal, truth), fused.d - d])
    # The covariance itself changes by a relative 1e-2 or so between draws: its mean is compared.
    expected = total(fused).mean(axis=0)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    found = error.T @ error / DRAWS
    assert (np.abs(found - expected) <= (MONTE_CARLO + 0.01) * scale).all()


def test_covariances_stay_symmetric_and_positive():
    for scale in (1e-4, 1e-2, 0.1):
        a, b = pair(scale, seed=4)
        fused = fusion.fuse_pair(a, b)
        for part in (fused.range_part, fused.pose_part):
            np.testing.assert_array_equal(part, part.transpose(0, 2, 1))
            assert np.linalg.eigvalsh(part).min() > 0.0
        assert (fused.normal[:, 2] > 0.0).all()


def test_a_far_worse_update_adds_nothing_and_a_far_better_one_decides():
    a, b = pair(1e-3, seed=5)
    worse = Planes.of(b.normal, b.d, 1e8 * b.range_part, 1e8 * b.pose_part)
    fused = fusion.fuse_pair(a, worse)
    np.testing.assert_allclose(fused.normal, a.normal, atol=1e-7)
    np.testing.assert_allclose(total(fused), total(a), rtol=1e-5, atol=1e-12)
    fused = fusion.fuse_pair(worse, a)
    np.testing.assert_allclose(fused.normal, a.normal, atol=1e-5)
    np.testing.assert_allclose(fused.d, a.d, atol=1e-5)


def test_height_alone_is_a_scalar_measurement():
    """Against the information form of the Kalman update, and its two parts sum to the total."""
    rng = np.random.default_rng(6)
    normal = upward_normals(rng, 30)
    prior = Planes.of(
        normal,
        np.zeros(30),
        random_covariances(rng, 30, 3, 1e-2),
        random_covariances(rng, 30, 3, 1e-2),
    )
    lever, height = 0.3 * rng.standard_normal((30, 2)), 0.02 * rng.standard_normal(30)
    noise, pose = rng.uniform(1e-5, 1e-3, (2, 30))
    fused = fusion.fuse_heights(prior, lever, height, noise, pose)
    for k in range(30):
        row = np.append(-lever[k], 1.0)
        before = np.linalg.inv(total(prior)[k])
        after = np.linalg.inv(before + np.outer(row, row) / (noise[k] + pose[k]))
        step = after @ row * height[k] / (noise[k] + pose[k])
        np.testing.assert_allclose(total(fused)[k], after, atol=1e-12)
        np.testing.assert_allclose(fused.normal[k], sphere.plus(normal[k], step[:2]), atol=1e-12)
        assert abs(fused.d[k] - step[2]) < 1e-12


def test_a_height_above_the_plane_lifts_it_there():
    """Sign of Eq. 29: with an exact height the plane passes through the point."""
    for lever3 in ((0.4, 0.2), (-0.3, 0.1), (0.0, 0.0)):
        loose = Planes.of(UP[None], np.zeros(1), 1e-4 * np.eye(3)[None], np.zeros((1, 3, 3)))
        basis = sphere.tangent_basis(UP)
        point = np.array([*lever3, 0.05])
        fused = fusion.fuse_heights(
            loose, (basis.T @ point)[None], np.array([0.05]), np.array([1e-12]), np.zeros(1)
        )
        rest = fused.normal[0] @ point - fused.d[0]
        assert abs(rest) < 1e-4  # second order of a few hundredths of a radian over 0.4 m


def test_an_update_about_another_height_is_shifted_to_it():
    """Fusing it as it is equals fusing it about the prior's origin."""
    rng = np.random.default_rng(1)
    normal, other = upward_normals(rng, 30, 0.4), upward_normals(rng, 30, 0.4)
    parts = [random_covariances(rng, 30, 3, 0.1) for _ in range(4)]
    prior = Planes.of(normal, np.zeros(30), *parts[:2])
    update = Planes.of(other, np.zeros(30), *parts[2:])
    height = rng.normal(0.0, 1.0, 30)
    delta = np.column_stack([np.zeros((30, 2)), -height])
    d, change = fusion.shift_origin(other, update.d, delta)
    moved = Planes(other, d, fusion.congruent(change[:, None], update.parts))
    found, expected = fusion.fuse_pair(prior, update, height), fusion.fuse_pair(prior, moved)
    for name in ("normal", "d", "parts"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=1e-12)
