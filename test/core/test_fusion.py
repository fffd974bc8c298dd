# SPDX-License-Identifier: Apache-2.0
"""Two estimates of a plane made one (Eq. 37 to Eq. 45), with pose errors alike or not."""

from typing import NamedTuple

import numpy as np
import pytest
from core import kernels
from core.builders import random_covariances, upward_normals
from core.kernels import plane

DRAWS = 20_000
MONTE_CARLO = 5.0 * np.sqrt(2.0 / DRAWS)


class Plane(NamedTuple):
    """A plane over one place: unit normal, height, m, covariances of (dphi, dd) about it."""

    normal: np.ndarray
    z: float
    range_part: np.ndarray
    pose_part: np.ndarray

    @property
    def total(self) -> np.ndarray:
        return self.range_part + self.pose_part


def fused(prior: Plane, other: Plane, common: float = 0.0) -> Plane:
    """Both over one place."""
    parts = [part.copy() for part in (prior.normal, prior.range_part, prior.pose_part)]
    measured = kernels.plane_parts(other.normal, other.range_part, other.pose_part)
    rise = plane.fuse(kernels.plane_parts(*parts), prior.z - other.z, measured, common)
    return Plane(parts[0], other.z + rise, *parts[1:])


def estimate(rng: np.random.Generator, truth: np.ndarray, parts: np.ndarray) -> Plane:
    """One estimate of the true plane through the origin, drawn from its two covariances."""
    error = rng.multivariate_normal(np.zeros(3), parts[0] + parts[1])
    normal = kernels.plus(truth, error[:2])
    return Plane(normal, error[2] / truth[2], *parts)


def seen_from(of: Plane, by: Plane) -> np.ndarray:
    """Covariance of a plane in the tangent of another, about the other's height."""
    change = np.eye(3)
    change[:2, :2] = kernels.tangent_change(of.normal, by.normal)
    moved = kernels.shifted(of.total, of.normal, np.array([0.0, 0.0, by.z - of.z]))
    return change @ moved @ change.T


def pairs(scale: float, seed: int = 1, count: int = 50):
    rng = np.random.default_rng(seed)
    for truth in upward_normals(rng, count):
        parts = random_covariances(rng, 4, 3, scale)
        yield estimate(rng, truth, parts[:2]), estimate(rng, truth, parts[2:])


def with_height(
    prior: Plane, lever: np.ndarray, variance: float, other: Plane, common: float, sloped: bool
) -> Plane:
    """A height over one place of a plane parallel to the prior, ``lever`` (2,) from its origin."""
    parts = [part.copy() for part in (prior.normal, prior.range_part, prior.pose_part)]
    given = lever, variance, other.pose_part, common, sloped
    rise = plane.fuse_height(kernels.plane_parts(*parts), prior.z - other.z, *given)
    return Plane(parts[0], other.z + rise, *parts[1:])


@pytest.mark.parametrize("common", [0.0, 0.6, 1.0])
def test_a_height_alone_is_a_plane_of_any_slope(common):
    rng = np.random.default_rng(8)
    for prior, other in pairs(0.05):
        other = other._replace(normal=prior.normal)
        lever, variance, any_slope = rng.uniform(-2.0, 2.0, 2), rng.uniform(1e-3, 1e-1), 1e4
        back = np.column_stack([np.eye(2), lever]).T
        part = any_slope * back @ back.T
        part[2, 2] += variance
        expected = fused(prior, other._replace(range_part=part), common)
        found = with_height(prior, lever, variance, other, common, True)
        np.testing.assert_allclose(found.normal, expected.normal, atol=1e-4)
        assert found.z == pytest.approx(expected.z, abs=1e-4)
        np.testing.assert_allclose(found.range_part, expected.range_part, atol=3e-4)
        np.testing.assert_allclose(found.pose_part, expected.pose_part, atol=3e-4)


def test_the_height_of_a_strip_turns_nothing():
    """Its slope is what it was, and so is how certain that is; the height gains what it can."""
    level, none = np.array([0.0, 0.0, 1.0]), np.zeros((3, 3))
    prior = Plane(level, 0.2, np.diag([0.04, 0.09, 0.01]), none)
    lever, variance = np.array([0.5, -1.0]), 0.02
    found = with_height(prior, lever, variance, Plane(level, 0.0, none, none), 0.0, False)
    gain = 0.01 / (0.01 + 0.5**2 * 0.04 + 0.09 + variance)
    assert found.z == pytest.approx(0.2 * (1.0 - gain))
    np.testing.assert_array_equal(found.normal, level)
    np.testing.assert_allclose(found.range_part[:2, :2], np.diag([0.04, 0.09]))
    assert found.range_part[2, 2] == pytest.approx(0.01 * (1.0 - gain))


def test_information_adds_and_the_plane_is_the_weighted_mean():
    """Against the two-observation least squares of Eq. 40-42, in the measured one's tangent."""
    for a, b in pairs(1e-4):
        weight = np.linalg.inv(np.stack([seen_from(a, b), b.total]))
        difference = np.append(kernels.minus(a.normal, b.normal), a.normal[2] * (a.z - b.z))
        step = np.linalg.solve(weight.sum(axis=0), weight[0] @ difference)
        found, expected = fused(a, b), np.linalg.inv(weight.sum(axis=0))
        assert np.abs(found.total - expected).max() < 2e-3 * np.abs(expected).max()
        second = 2.0 * np.sum(difference**2)
        np.testing.assert_allclose(kernels.minus(found.normal, b.normal), step[:2], atol=second)
        assert abs(b.normal[2] * (found.z - b.z) - step[2]) < second


@pytest.mark.parametrize("common", [0.0, 0.4, 1.0])
def test_covariances_stay_symmetric_and_positive(common):
    """However small they are: below 1e-12 is round-off."""
    for scale in (1e-8, 1e-4, 1e-2, 0.1):
        for a, b in pairs(scale, seed=4):
            found = fused(a, b, common)
            assert np.diag(found.range_part).min() >= 1e-12
            for part in (found.range_part, found.pose_part):
                assert np.abs(part - part.T).max() < 1e-15 + 1e-12 * np.abs(part).max()
                assert np.linalg.eigvalsh(part).min() > 0.0
            assert found.normal[2] > 0.0


@pytest.mark.parametrize("common", [0.0, 0.4, 1.0])
def test_an_error_in_common_decides_nothing_and_does_not_average_out(common):
    """What is common of the pose parts P and Q stays as it was, weighed as heights are:
    common ((1 - k) P + k Q) + (1 - common) ((I - K) P (I - K)^T + K Q K^T)."""
    rng = np.random.default_rng(6)
    for normal in upward_normals(rng, 20):
        a, p, b, q = random_covariances(rng, 4, 3, 1e-3)
        a[2, :2] = a[:2, 2] = b[2, :2] = b[:2, 2] = 0.0  # both about their pivots
        found = fused(Plane(normal, 0.0, a, p), Plane(normal, 0.0, b, q), common)
        one, other = a + (1.0 - common) * p, b + (1.0 - common) * q
        gain = one @ np.linalg.inv(one + other)
        left, k = np.eye(3) - gain, gain[2, 2]
        k = min(max(k, 0.0), 1.0)
        mean = left @ p @ left.T + gain @ q @ gain.T
        expected = common * ((1.0 - k) * p + k * q) + (1.0 - common) * mean
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found.pose_part, expected, atol=1e-9 * scale)
        expected = left @ a @ left.T + gain @ b @ gain.T
        np.testing.assert_allclose(found.range_part, expected, atol=1e-9 * np.abs(expected).max())


def test_the_pose_part_is_carried_to_the_tangent_of_the_measured_plane():
    """Of planes that lean apart: nothing of their errors is averaged, all is mixed by heights."""
    rng = np.random.default_rng(8)
    for one, other in zip(upward_normals(rng, 20), upward_normals(rng, 20), strict=True):
        p, q = random_covariances(rng, 2, 3, 0.1)
        known, seen = np.diag([1e-4, 2e-4, 3e-4]), np.diag([2e-4, 1e-4, 1e-4])
        found = fused(Plane(one, 0.0, known, p), Plane(other, 0.0, seen, q), 1.0)
        change = np.eye(3)
        change[:2, :2] = kernels.tangent_change(one, other)
        expected = 0.25 * change @ p @ change.T + 0.75 * q
        np.testing.assert_allclose(found.pose_part, expected, atol=1e-9 * expected.max())


@pytest.mark.parametrize("common", [0.0, 0.5, 1.0])
def test_correlated_pose_errors_against_monte_carlo(common):
    """Height errors of two looks with this correlation: the told deviation is not too small."""
    rng = np.random.default_rng(7)
    truth, sigma, noise = np.array([0.0, 0.0, 1.0]), 0.3, 0.05
    slope = np.diag([1e-6, 1e-6, 0.0])
    shared = rng.standard_normal((DRAWS, 1)) * np.sqrt(common)
    pose = sigma * (shared + np.sqrt(1.0 - common) * rng.standard_normal((DRAWS, 2)))
    first, second = (pose + noise * rng.standard_normal((DRAWS, 2))).T
    looks = (slope + np.diag([0.0, 0.0, noise**2]), np.diag([0.0, 0.0, sigma**2]))
    found = fused(Plane(truth, 0.0, *looks), Plane(truth, 1.0, *looks), common)
    z = first + found.z * (second - first)  # of level planes it is a weighted mean
    assert np.var(z) == pytest.approx(found.total[2, 2], rel=MONTE_CARLO)
