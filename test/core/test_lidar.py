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
    point_covariances,
    random_covariances,
    scan,
)
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from quadtree_lss.onboard.core.geometry import morton, rotations
from quadtree_lss.onboard.core.sensing import lidar
from quadtree_lss.onboard.core.sensing.register import register

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
    order = np.lexsort(found.points.T)
    expected = expected[np.lexsort(expected.T)]
    np.testing.assert_allclose(found.points[order] + found.origin, expected, atol=1e-9)
    cells = [morton.decode(key) for key in found.key[order].tolist()]
    np.testing.assert_array_equal(cells, (expected[:, :2] / domain.finest_size).astype(int))


def test_points_of_any_kind_of_number_are_taken():
    pose, config = make_pose((8.0, 8.0, 100.0)), configured()
    points = np.array([[1, 2, 100], [-3, 0, 99], [2, 2, 98]])
    expected, _ = register(points.astype(np.float64), pose, config.lidar, domain_of(config))
    for kind in (np.int64, np.int16, np.float32, ">f8"):
        found, _ = register(points.astype(kind), pose, config.lidar, domain_of(config))
        np.testing.assert_array_equal(found.points, expected.points)


@pytest.mark.parametrize("form", ["organised", "unorganised", "float32", "every other"])
def test_points_of_a_cell_are_one_run_in_the_order_of_the_scan(form):
    pose = make_pose((8.0, 8.0, 100.0))
    config = configured()
    x, y = lattice(-2.0, 0.0, 16.0, 40)
    points = scan(flat(), x, y, pose, 0.3, np.random.default_rng(1))
    points[::7] = np.nan
    if form == "organised":
        points = points.reshape(40, 40, 3)
    elif form == "float32":
        points = points.astype(np.float32)
    elif form == "every other":
        points = np.repeat(points, 2, axis=0)[::2]
    found, dropped = register(points, pose, config.lidar, domain_of(config))
    place = points.reshape(-1, 3).astype(float) @ pose.rotation_map_lidar.T
    cell = (place[:, :2] + pose.position[:2]) / domain_of(config).finest_size
    inside = np.flatnonzero((cell >= 0.0).all(axis=1))
    key = np.array([morton.encode(int(x), int(y)) for x, y in cell[inside]])
    order = np.argsort(key, kind="stable")
    np.testing.assert_array_equal(found.key, key[order])
    np.testing.assert_allclose(found.points, place[inside[order]], atol=1e-12)
    lost = {"no_return": int(np.isnan(place[:, 0]).sum()), "range": 0, "isolated": 0}
    returns = np.isfinite(place[:, 0])
    assert dropped == {**lost, "outside": int(returns.sum()) - len(inside)}
    assert found.centre is None


def test_a_scan_that_somebody_keeps_is_not_written_over():
    config = configured()
    scans = [
        scan(flat(z), *lattice(0.0, 0.0, 16.0, 40), make_pose((8.0, 8.0, 100.0)), 0.0)
        for z in (0.0, 1.0, 2.0)
    ]
    args = (make_pose((8.0, 8.0, 100.0)), config.lidar, domain_of(config))
    kept, _ = register(scans[0], *args)
    part = register(scans[1], *args)[0].points[5:]
    key = memoryview(register(scans[1], *args)[0].key)
    before = kept.points.copy(), part.copy(), bytes(key)
    last, _ = register(scans[2], *args)
    np.testing.assert_array_equal(kept.points, before[0])
    np.testing.assert_array_equal(part, before[1])
    assert bytes(key) == before[2]
    np.testing.assert_allclose(last.points[:, 2], -98.0)


def test_a_scan_that_misses_the_domain_says_where_it_fell():
    pose = make_pose((80.0, 80.0, 100.0))
    config = configured()
    points = scan(flat(), *lattice(70.0, 72.0, 16.0, 40), pose, 0.0)
    points[::7] = np.nan
    found, dropped = register(points, pose, config.lidar, domain_of(config))
    assert len(found.key) == 0
    assert dropped["outside"] == int(np.isfinite(points[:, 0]).sum())
    middle = np.nanmean(points @ pose.rotation_map_lidar.T, axis=0) + pose.position
    np.testing.assert_allclose(found.centre, middle[:2], atol=1e-9)


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
        # Eq. 16 perturbs on the right, R_hat = R exp(dR): about the map's axes the error is R dR.
        covariance = block_diag(of_position, rotation @ of_attitude @ rotation.T)
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
    assert_covariance(samples, point_covariances(mean, pose, noise)[0])
