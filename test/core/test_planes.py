# SPDX-License-Identifier: Apache-2.0
"""Plane algebra: moments, regressions, covariances and changes of origin against numeric ones."""

from __future__ import annotations

import numpy as np
import pytest
from core.builders import random_covariances, transported, unit_vectors, upward_normals
from scipy.optimize import minimize

from quadtree_lss.core.geometry import fusion, planes, rotations, sphere

STEP = 1e-6


def perturbed(normal: np.ndarray, d: float, error: np.ndarray) -> tuple[np.ndarray, float]:
    return sphere.plus(normal, error[:2]), d + error[2]


def differentiated(function, size: int) -> np.ndarray:
    """Central differences of a function of ``size`` numbers at zero."""
    columns = [(function(STEP * e) - function(-STEP * e)) / (2.0 * STEP) for e in np.eye(size)]
    return np.stack(columns, axis=-1)


def test_moments_of_groups_are_the_plain_ones():
    rng = np.random.default_rng(1)
    group = np.concatenate([np.arange(6), rng.integers(0, 6, 300)])
    points, lidar = rng.standard_normal((3, 306)), np.array([20.0, 10.0, 50.0])
    moment = planes.moments(group, 6, points, lidar)
    for k in range(6):
        mine = points[:, group == k]
        off = mine - mine.mean(axis=1, keepdims=True)
        assert moment.count[k] == mine.shape[1]
        np.testing.assert_allclose(moment.mean[k], mine.mean(axis=1), atol=1e-12)
        np.testing.assert_allclose(moment.scatter[k], off @ off.T, atol=1e-11)
        ray = mine.mean(axis=1) - lidar
        np.testing.assert_allclose(moment.ray[k], ray / np.linalg.norm(ray), atol=1e-12)


def test_inverse_symmetric():
    matrices = random_covariances(np.random.default_rng(2), 50, 3, 0.3)
    np.testing.assert_allclose(
        planes.inverse_symmetric(matrices) @ matrices,
        np.broadcast_to(np.eye(3), (50, 3, 3)),
        atol=1e-8,
    )


def test_horizontal_conditioning_gives_the_eigenvalues():
    scatter = random_covariances(np.random.default_rng(3), 50, 3, 1.0)
    least, greatest = planes.horizontal_conditioning(scatter)
    expected = np.linalg.eigvalsh(scatter[:, :2, :2])
    np.testing.assert_allclose(np.stack([least, greatest], axis=-1), expected, atol=1e-12)


@pytest.mark.parametrize("spread", [0.0, 0.7])
def test_height_regression_minimises_its_cost(spread):
    """Least squares of z on (1, x, y) with two rows more for the slope prior."""
    rng = np.random.default_rng(4)
    prior = upward_normals(rng, 20)
    points = rng.standard_normal((20, 40, 3)) * (1.0, 0.6, 0.3)
    off = points - points.mean(axis=1, keepdims=True)
    normals = planes.fit_height(off.transpose(0, 2, 1) @ off, prior, np.full(20, spread))
    for cloud, before, normal in zip(points, prior, normals, strict=True):
        weight = np.sqrt(spread)
        rows = np.column_stack([np.ones(40), cloud[:, :2]])
        rows = np.vstack([rows, [[0.0, weight, 0.0], [0.0, 0.0, weight]]])
        right = np.concatenate([cloud[:, 2], -weight * before[:2] / before[2]])
        _, a, b = np.linalg.lstsq(rows, right, rcond=None)[0]
        expected = np.array([-a, -b, 1.0]) / np.sqrt(1.0 + a * a + b * b)
        np.testing.assert_allclose(normal, expected, atol=1e-12)


def test_orthogonal_fit_minimises_the_orthogonal_residuals():
    """The eigenvector of the least eigenvalue, reached from a height regression."""
    rng = np.random.default_rng(5)
    normals = upward_normals(rng, 30, 0.9)
    basis = sphere.tangent_basis(normals)
    flat = rng.uniform(-1.0, 1.0, (30, 60, 2))
    points = np.einsum("mij,mkj->mki", basis, flat)
    points += 0.05 * rng.standard_normal(points.shape)
    off = points - points.mean(axis=1, keepdims=True)
    scatter = off.transpose(0, 2, 1) @ off
    start = planes.fit_height(scatter, np.tile([0.0, 0.0, 1.0], (30, 1)), np.zeros(30))
    found = planes.fit_orthogonal(scatter, start)
    expected = np.linalg.eigh(scatter)[1][:, :, 0]
    expected *= np.sign(expected[:, 2:])
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_upward_keeps_the_plane_and_stays_off_the_horizon():
    n = unit_vectors(np.random.default_rng(6), 102)
    n[:2] = (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)
    up = planes.upward(n)
    assert (up[:, 2] >= planes.MIN_UP - 1e-15).all()
    np.testing.assert_allclose(np.linalg.norm(up, axis=1), 1.0, atol=1e-12)
    same = np.abs(np.einsum("ni,ni->n", n, up))
    steep = np.abs(n[:, 2]) < planes.MIN_UP
    np.testing.assert_allclose(same[~steep], 1.0, atol=1e-12)
    assert (same[steep] > 1.0 - planes.MIN_UP**2).all()  # tilted by its arcsine at most


def test_slope_covariance_is_the_inverse_hessian():
    """Of the cost sum w (n.(r - mean))^2 / 2 over dphi, by differences of the cost."""
    rng = np.random.default_rng(7)
    points = rng.uniform(-1.0, 1.0, (80, 3)) * (1.0, 1.0, 0.0)
    weight = 1.0 / 0.05**2
    normal = np.array([[0.0, 0.0, 1.0]])
    off = points - points.mean(axis=0)

    def cost(phi: np.ndarray) -> float:
        return 0.5 * weight * float(np.sum((off @ sphere.plus(normal[0], phi)) ** 2))

    h = 1e-3
    axes = h * np.eye(2)
    hessian = np.array(
        [
            [(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / (4.0 * h * h) for b in axes]
            for a in axes
        ]
    )
    found = planes.slope_covariance(
        weight * (off.T @ off)[None], sphere.tangent_basis(normal), np.zeros(1)
    )[0]
    np.testing.assert_allclose(found @ hessian, np.eye(2), atol=1e-4)  # h^2 relative, and cross


def test_shift_of_origin_keeps_the_plane_exactly():
    """Also from far away: distances of points to the plane stay, 100 km off to rounding."""
    rng = np.random.default_rng(8)
    normal = upward_normals(rng, 40)
    d = rng.standard_normal(40)
    points = rng.standard_normal((40, 3))
    for reach in (1.0, 1e3, 1e5):
        delta = reach * rng.standard_normal((40, 3))
        moved, _ = fusion.shift_origin(normal, d, delta)
        before = np.einsum("mi,mi->m", normal, points) - d
        after = np.einsum("mi,mi->m", normal, points - delta) - moved
        np.testing.assert_allclose(after, before, atol=2e-15 * reach * 10)


def test_shift_of_origin_maps_errors_as_differentiation_does():
    rng = np.random.default_rng(9)
    deltas = 30.0 * unit_vectors(rng, 20)
    for normal, delta in zip(upward_normals(rng, 20, 1.2), deltas, strict=True):
        moved, change = fusion.shift_origin(normal[None], np.array([0.3]), delta[None])

        def after(error, normal=normal, delta=delta, moved=moved):
            n, d = perturbed(normal, 0.3, error)
            return np.append(sphere.minus(n, normal), d - n @ delta - moved[0])

        np.testing.assert_allclose(change[0], differentiated(after, 3), atol=1e-6)


def test_there_and_back_changes_nothing():
    rng = np.random.default_rng(10)
    normal, delta = upward_normals(rng, 20), 100.0 * unit_vectors(rng, 20)
    covariance = random_covariances(rng, 20, 3, 0.05)
    d, there = fusion.shift_origin(normal, np.zeros(20), delta)
    d, back = fusion.shift_origin(normal, d, -delta)
    np.testing.assert_allclose(d, 0.0, atol=1e-12)
    both = back @ there
    np.testing.assert_allclose(both @ covariance @ both.transpose(0, 2, 1), covariance, atol=1e-10)


def test_moving_up_is_a_vertical_shift():
    rng = np.random.default_rng(11)
    normal, rise = upward_normals(rng, 20), 5.0 * rng.standard_normal(20)
    covariance = random_covariances(rng, 20, 3, 0.05)
    delta = np.column_stack([np.zeros(20), np.zeros(20), rise])
    _, change = fusion.shift_origin(normal, np.zeros(20), delta)
    np.testing.assert_allclose(
        fusion.move_up(normal, covariance, rise),
        change @ covariance @ change.transpose(0, 2, 1),
        atol=1e-12,
    )


def test_transport_is_the_derivative_of_the_difference():
    rng = np.random.default_rng(12)
    for of, to in zip(upward_normals(rng, 30, 1.4), upward_normals(rng, 30, 1.4), strict=True):
        if of @ to < 0.1:
            continue  # beyond a quarter turn the other name of the plane is nearer
        change = differentiated(lambda e, of=of, to=to: sphere.minus(sphere.plus(of, e), to), 2)
        full = np.eye(3)
        full[:2, :2] = change
        covariance = random_covariances(rng, 1, 3, 0.02)
        np.testing.assert_allclose(
            transported(covariance, of[None], to[None])[0],
            full @ covariance[0] @ full.T,
            rtol=1e-6,
            atol=1e-10,
        )


def test_transport_to_itself_changes_nothing():
    rng = np.random.default_rng(13)
    normal, covariance = upward_normals(rng, 20), random_covariances(rng, 20, 3, 0.1)
    np.testing.assert_allclose(transported(covariance, normal, normal), covariance, atol=1e-14)


def test_pose_jacobian_is_the_derivative_of_a_rigid_motion():
    rng = np.random.default_rng(14)
    for normal in upward_normals(rng, 20):
        origin, position = rng.standard_normal(3), 50.0 * rng.standard_normal(3)

        def moved(error, normal=normal, origin=origin, position=position):
            turn = rotations.exp(error[3:])
            through = turn @ (origin - position) + position + error[:3]
            n = turn @ normal
            return np.append(sphere.minus(n, normal), n @ (through - origin))

        basis = sphere.tangent_basis(normal)[None]
        found = planes.pose_jacobian(normal[None], basis, (origin - position)[None])[0]
        np.testing.assert_allclose(found, differentiated(moved, 6), atol=1e-7)


def test_pose_part_is_the_jacobian_around_the_covariance():
    rng = np.random.default_rng(15)
    normal, arm = upward_normals(rng, 5), 50.0 * unit_vectors(rng, 5)
    basis, covariance = sphere.tangent_basis(normal), random_covariances(rng, 1, 6, 0.01)[0]
    jacobian = planes.pose_jacobian(normal, basis, arm)
    np.testing.assert_allclose(
        planes.pose_part(normal, basis, arm, planes.covariance_root(covariance)),
        jacobian @ covariance @ jacobian.transpose(0, 2, 1),
        rtol=1e-9,
        atol=1e-15,
    )


def test_covariance_root_ignores_negative_eigenvalues():
    for matrix in (np.diag([4.0, 0.0, -1.0]), np.zeros((3, 3))):
        root = planes.covariance_root(matrix)
        np.testing.assert_allclose(root @ root.T, np.maximum(matrix, 0.0), atol=1e-12)


def test_orthogonal_fit_agrees_with_a_general_optimiser_on_several_scans():
    """One free offset per scan; the weights 1 / (n' Sigma n) held at the optimum (Eq. 35)."""
    rng = np.random.default_rng(17)
    truth = upward_normals(rng, 1, 0.4)[0]
    basis = sphere.tangent_basis(truth)
    clouds = []
    for count, offset in ((30, 0.4), (50, -0.2), (8, 0.05)):
        flat = basis @ rng.uniform(-1.0, 1.0, (2, count))
        clouds.append((flat + truth[:, None] * offset + 0.02 * rng.standard_normal(flat.shape)).T)
    weights = np.array([400.0, 900.0, 100.0])

    def cost(state: np.ndarray) -> float:
        n = sphere.plus(truth, state[:2])
        return 0.5 * sum(
            w * np.sum((cloud @ n - gamma) ** 2)
            for w, cloud, gamma in zip(weights, clouds, state[2:], strict=True)
        )

    best = minimize(cost, np.zeros(5), method="BFGS", options={"gtol": 1e-10})
    scatter = np.zeros((3, 3))
    for w, cloud in zip(weights, clouds, strict=True):
        off = cloud - cloud.mean(axis=0)
        scatter += w * off.T @ off
    start = planes.fit_height(scatter[None], np.array([[0.0, 0.0, 1.0]]), np.zeros(1))
    found = planes.fit_orthogonal(scatter[None], start)[0]
    np.testing.assert_allclose(found, sphere.plus(truth, best.x[:2]), atol=1e-7)
