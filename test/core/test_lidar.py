# SPDX-License-Identifier: Apache-2.0
"""From ranges to points in the map, each in its cell: Eq. 14 and Eq. 15."""

import numpy as np
import pytest
from core.builders import configured
from core.scenes import flat, lattice, make_pose, scan
from scipy.spatial.transform import Rotation

from quadtree_lss.onboard.core.geometry import morton
from quadtree_lss.onboard.core.sensing import lidar
from quadtree_lss.onboard.core.sensing.register import register
from quadtree_lss.onboard.core.tree.domain import Domain


def test_angles_and_range_come_back_from_the_point():
    """Eq. 14: z boresight, x right for positive azimuth, y down for negative elevation."""
    rng = np.random.default_rng(1)
    rho = rng.uniform(1.0, 500.0, (8, 5))
    azimuth, elevation = rng.uniform(-1.2, 1.2, (2, 8, 5))
    p = lidar.points_from_ranges(rho, azimuth, elevation)
    assert p.shape == (8, 5, 3)
    np.testing.assert_allclose(np.linalg.norm(p, axis=-1), rho, rtol=1e-12)
    np.testing.assert_allclose(np.arctan2(p[..., 0], p[..., 2]), azimuth, atol=1e-12)
    np.testing.assert_allclose(np.arcsin(-p[..., 1] / rho), elevation, atol=1e-12)


@pytest.mark.parametrize("form", ["organised", "unorganised", "float32", "every other"])
def test_points_of_a_cell_are_one_run_in_the_order_of_the_scan(form):
    """Each where Eq. 15 has it, in the finest cell under it."""
    rotation = Rotation.from_euler("xyz", [2.6, -0.2, 1.0]).as_matrix()
    pose, config = make_pose((8.0, 7.0, 100.0), rotation=rotation), configured()
    x, y = lattice(-1.93, 0.07, 15.9, 40)
    points = scan(flat(), x, y, pose, 0.3, np.random.default_rng(1))
    points[::7] = np.nan
    if form == "organised":
        points = points.reshape(40, 40, 3)
    elif form == "float32":
        points = points.astype(np.float32)
    elif form == "every other":
        points = np.repeat(points, 2, axis=0)[::2]
    found, dropped = register(points, pose, config.lidar, Domain.of(config.domain))
    place = points.reshape(-1, 3).astype(float) @ pose.rotation_map_lidar.T
    cell = (place[:, :2] + pose.position[:2]) / Domain.of(config.domain).finest_size
    inside = np.flatnonzero((cell >= 0.0).all(axis=1))
    key = np.array([morton.encode(int(x), int(y)) for x, y in cell[inside]])
    order = np.argsort(key, kind="stable")
    np.testing.assert_array_equal(found.key, key[order])
    np.testing.assert_allclose(found.points, place[inside[order]], atol=1e-12)
    lost = {"no_return": int(np.isnan(place[:, 0]).sum()), "range": 0, "isolated": 0}
    returns = np.isfinite(place[:, 0])
    assert dropped == {**lost, "outside": int(returns.sum()) - len(inside)}
    assert found.centre is None


def test_a_scan_that_misses_the_domain_says_where_it_fell():
    pose = make_pose((80.0, 80.0, 100.0))
    config = configured()
    points = scan(flat(), *lattice(70.0, 72.0, 16.0, 40), pose, 0.0)
    points[::7] = np.nan
    found, dropped = register(points, pose, config.lidar, Domain.of(config.domain))
    assert len(found.key) == 0
    assert dropped["outside"] == int(np.isfinite(points[:, 0]).sum())
    middle = np.nanmean(points @ pose.rotation_map_lidar.T, axis=0) + pose.position
    np.testing.assert_allclose(found.centre, middle[:2], atol=1e-9)


def test_a_covariance_is_made_positive_and_bounded():
    values = np.array([-1.0, 0.0, 1e-6, 0.5, 3.0, 2e6])
    axes = np.linalg.qr(np.random.default_rng(4).standard_normal((6, 6)))[0]
    expected = (axes * np.clip(values, 0.0, 1e6)) @ axes.T
    found = lidar.clip_covariance((axes * values) @ axes.T)
    np.testing.assert_allclose(found, expected, atol=1e-8)
