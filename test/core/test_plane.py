# SPDX-License-Identifier: Apache-2.0
"""One plane: moments, regressions, covariances and changes of origin against numeric ones."""

import numpy as np
import pytest
from core import kernels
from core.builders import (
    configured,
    differentiated,
    random_covariances,
    unit_vectors,
    upward_normals,
)
from core.kernels import filled, plane

from quadtree_lss.onboard.core.geometry import rotations
from quadtree_lss.onboard.core.mapping.measure import Rules

UP = np.array([0.0, 0.0, 1.0])


def scatter_of(points: np.ndarray) -> np.ndarray:
    off = points - points.mean(axis=0)
    return off.T @ off


def fitted(points: np.ndarray, prior=UP, method: str = "none", noise: float = 1e-3):
    """What `measure` makes of points (N, 3) about the lidar that fill a cell of 2 m below it."""
    rules = Rules(configured(noise=noise, mapping={"paper": method}))
    return kernels.fit(rules, points, 0.0, 0.0, 2.0, prior, np.zeros((6, 6)))[0]


def slope_part(points: np.ndarray, normal, variance: float) -> np.ndarray:
    """`plane.slope_covariance` of a fit to points (N, 3): (2, 2), rad^2."""
    six = scatter_of(points)[np.triu_indices(3)]
    return filled(plane.slope_covariance, (4,), six, normal, variance)[0].reshape(2, 2)


@pytest.mark.parametrize("count", [1, 2, 30])
def test_moments_are_the_plain_ones(count):
    points = np.random.default_rng(1).standard_normal((count, 3)) + (50.0, -30.0, 400.0)
    run = fitted(points)
    np.testing.assert_allclose(run.centroid, points.mean(axis=0), atol=1e-12)
    np.testing.assert_allclose(run.scatter, scatter_of(points)[np.triu_indices(3)], atol=1e-11)


def test_inverse_is_the_inverse():
    """Also where metres and radians differ by nine orders of magnitude."""
    rng = np.random.default_rng(2)
    for matrix in random_covariances(rng, 50, 3, 0.3):
        scale = np.diag(10.0 ** rng.uniform(-9.0, 0.0, 3))
        matrix = scale @ matrix @ scale
        (found,) = filled(plane.inverse_symmetric, (9,), matrix.ravel())
        np.testing.assert_allclose(found.reshape(3, 3) @ matrix, np.eye(3), atol=1e-6)


@pytest.mark.parametrize("noise", [1e-4, 0.8])
def test_height_regression_minimises_its_cost(noise):
    """Least squares of z on (1, x, y) with two rows more for the slope prior."""
    rng = np.random.default_rng(4)
    for before in upward_normals(rng, 20):
        cloud = rng.uniform(-1.0, 1.0, (40, 3)) * (1.0, 1.0, 0.3)
        rows = np.column_stack([np.ones(40), cloud[:, :2]])
        rows = np.vstack([rows, [[0.0, noise, 0.0], [0.0, 0.0, noise]]])
        right = np.concatenate([cloud[:, 2], -noise * before[:2] / before[2]])
        _, a, b = np.linalg.lstsq(rows, right, rcond=None)[0]
        expected = np.array([-a, -b, 1.0]) / np.sqrt(1.0 + a * a + b * b)
        found = fitted(cloud - (0.0, 0.0, 9.0), before, noise=noise).normal
        np.testing.assert_allclose(found, expected, atol=1e-11)


def test_orthogonal_fit_minimises_the_orthogonal_residuals():
    """The eigenvector of the least eigenvalue, reached from a height regression."""
    rng = np.random.default_rng(5)
    for normal in upward_normals(rng, 30, 0.9):
        x, y = rng.uniform(-1.0, 1.0, (2, 60))
        points = np.column_stack([x, y, -(normal[0] * x + normal[1] * y) / normal[2] - 9.0])
        points += 0.05 * rng.standard_normal(points.shape)
        expected = np.linalg.eigh(scatter_of(points))[1][:, 0]
        found = fitted(points, method="fit", noise=0.05).normal
        np.testing.assert_allclose(found, expected * np.sign(expected[2]), atol=1e-9)


def test_upward_keeps_the_plane_and_stays_off_the_horizon():
    steepest = 0.25
    for n in np.vstack([np.eye(3), -np.eye(3), unit_vectors(np.random.default_rng(6), 100)]):
        up = n.copy()
        plane.orient_up(up)
        assert up[2] >= steepest - 1e-15
        assert np.linalg.norm(up) == pytest.approx(1.0, abs=1e-12)
        if abs(n[2]) >= steepest:
            assert abs(n @ up) == pytest.approx(1.0, abs=1e-12)
        else:
            assert abs(n @ up) > 1.0 - steepest**2  # tilted by its arcsine at most


def test_slope_covariance_is_the_inverse_hessian():
    """Of the cost sum (n.(r - mean))^2 / (2 sigma^2) over dphi, by differences of the cost."""
    rng = np.random.default_rng(7)
    sigma, h = 0.05, 1e-3
    for normal in upward_normals(rng, 10, 1.0):
        off = rng.uniform(-1.0, 1.0, (80, 2)) @ kernels.tangent_basis(normal).T
        off -= off.mean(axis=0)

        def cost(phi: np.ndarray, off=off, normal=normal) -> float:
            return 0.5 * float(np.sum((off @ kernels.plus(normal, phi)) ** 2)) / sigma**2

        hessian = [
            [(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / (4.0 * h * h) for b in axes]
            for axes in [h * np.eye(2)]
            for a in axes
        ]
        found = slope_part(off, normal, sigma**2)
        # h^2 relative.
        np.testing.assert_allclose(found @ hessian, np.eye(2), atol=1e-3)


def test_a_direction_that_no_point_tells_is_not_known():
    line = np.outer(np.linspace(-1.0, 1.0, 50), (1.0, 0.0, 0.0))
    found = slope_part(line, UP, 0.01**2)
    assert found[0, 0] < 1e-5
    assert found[1, 1] > 90.0


def test_error_about_another_place_is_that_of_the_plane_through_the_centroid():
    """dd = dd_0 + lever.dphi: by differences of the plane's offset over the new origin."""
    rng = np.random.default_rng(8)
    for normal in upward_normals(rng, 10):
        slope = random_covariances(rng, 1, 2, 0.02)[0]
        arm = rng.standard_normal(3)  # centroid minus origin
        change = differentiated(lambda e, n=normal, arm=arm: kernels.plus(n, e) @ arm, 2)
        jacobian = np.block([[np.eye(2), np.zeros((2, 1))], [change, np.ones((1, 1))]])
        before = np.block([[slope, np.zeros((2, 1))], [np.zeros((1, 2)), np.array([[1e-4]])]])
        lever = kernels.tangent_basis(normal).T @ arm
        (found,) = filled(plane.covariance_about, (9,), slope.ravel(), 1e-4, *lever)
        np.testing.assert_allclose(found.reshape(3, 3), jacobian @ before @ jacobian.T, atol=1e-9)


def test_shift_of_origin_maps_errors_as_differentiation_does():
    rng = np.random.default_rng(9)
    for normal in upward_normals(rng, 20, 1.2):
        delta = 30.0 * unit_vectors(rng, 1)[0]

        def after(error, normal=normal, delta=delta):
            n = kernels.plus(normal, error[:2])
            return np.append(kernels.minus(n, normal), error[2] - (n - normal) @ delta)

        covariance = random_covariances(rng, 1, 3, 0.05)[0]
        change = differentiated(after, 3)
        lever = delta @ kernels.tangent_basis(normal)
        expected = change @ covariance @ change.T
        height = plane.offset_variance(covariance.ravel(), *lever)
        assert height == pytest.approx(expected[2, 2], rel=1e-6)
        found = kernels.shifted(covariance, normal, delta)
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_pose_part_is_the_covariance_of_a_rigid_motion():
    """Its Jacobian by differences of a plane that is moved as a whole about the lidar."""
    rng = np.random.default_rng(14)
    for normal in upward_normals(rng, 20):
        arm, sigma = 50.0 * rng.standard_normal(3), random_covariances(rng, 1, 6, 0.01)[0]

        def moved(error, normal=normal, arm=arm):
            turn = rotations.exp(error[3:])
            n = turn @ normal
            return np.append(kernels.minus(n, normal), n @ (turn @ arm + error[:3] - arm))

        jacobian = differentiated(moved, 6)
        expected = jacobian @ sigma @ jacobian.T
        basis = kernels.tangent_basis(normal).T.ravel()
        (found,) = filled(plane.pose_part, (9,), normal, basis, arm, sigma.ravel())
        np.testing.assert_allclose(found.reshape(3, 3), expected, rtol=1e-5, atol=1e-8)
