# SPDX-License-Identifier: Apache-2.0
"""What children inherit: a leaf that divides does not forget what earlier scans said of it."""

from __future__ import annotations

import numpy as np
import pytest
from core.builders import (
    configured,
    flat,
    make_pose,
    mapped,
    pose_covariance,
    scan,
    scattered,
    slope,
)

from quadtree_lss.core.mapping.mapper import Mapper
from quadtree_lss.core.sensing.lidar import Pose


def block(x, y):
    """Level ground with one block of half a metre."""
    return np.where((np.abs(x - 5.0) < 0.5) & (np.abs(y - 5.0) < 0.5), 0.5, 0.0)


def seen_from(mapper, surface, x, y, estimate: Pose, rise: float, rng) -> None:
    """One scan whose estimated pose is ``rise`` too high: so is all the ground it shows."""
    true = Pose(
        estimate.stamp_ns,
        estimate.position - (0.0, 0.0, rise),
        estimate.rotation_map_lidar,
        estimate.covariance,
    )
    mapper.update(scan(surface, x, y, true, 0.02, rng), estimate)


def test_children_keep_the_mean_height_of_all_scans():
    config = configured(lidar={"range_noise": 0.02}, mapping={"align": False})
    mapper, rng = Mapper(config), np.random.default_rng(2)
    pose = make_pose((8.0, 8.0, 500.0), pose_covariance(0.1, 1e-9))
    for rise in (0.1, 0.1, 0.1):
        x, y = scattered(rng, 0.0, 0.0, 16.0, 8000)
        seen_from(mapper, lambda x, y: 0.0 * x, x, y, pose, rise, rng)
    leaves = mapper.leaves.count
    x, y = scattered(rng, 0.0, 0.0, 16.0, 8000)
    seen_from(mapper, block, x, y, pose, -0.2, rng)
    cells = mapper.snapshot()
    assert len(cells.level) > leaves
    divided = cells.measured & (cells.level > config.domain.min_level)
    beside = np.maximum(np.abs(cells.x - 5.0), np.abs(cells.y - 5.0)) > 0.5 + 0.5 * cells.size
    # Four scans of equal covariance: (3 * 0.1 - 0.2) / 4, not the -0.2 of the scan that divides.
    # The block, which only that scan saw, lifts its fit of the 4 m leaf by 0.5 m / 16.
    np.testing.assert_allclose(np.median(cells.z[divided & beside]), 0.025, atol=0.04)


def test_children_keep_the_pose_part_of_all_scans():
    config = configured(lidar={"range_noise": 0.02}, mapping={"align": False})
    mapper, rng = Mapper(config), np.random.default_rng(2)
    pose = make_pose((8.0, 8.0, 500.0), pose_covariance(0.1, 1e-9))
    for surface in (flat(), flat(), flat(), block):
        x, y = scattered(rng, 0.0, 0.0, 16.0, 8000)
        seen_from(mapper, surface, x, y, pose, 0.0, rng)
    cells = mapper.snapshot()
    divided = cells.measured & (cells.level > config.domain.min_level)
    assert divided.any()
    # Four scans of 0.1 m each: 0.01 m^2 / 4, not the 0.01 m^2 of the scan that divides.
    np.testing.assert_allclose(cells.covariance_pose[divided, 2, 2], 0.0025, rtol=0.3)


def test_an_inherited_slope_weighs_as_many_points_as_are_set():
    """Five points with the scatter of a full cell: half way to the parent's slope."""
    config = configured(
        domain={"min_level": 2, "max_level": 3},
        lidar={"range_noise": 0.01},
        mapping={"slope_prior_points": 5.0, "align": False},
    )
    mapper = mapped(config, slope(0.2, 0.0), density=60.0, scans=1)
    mapper.leaves.divide(np.arange(1))

    def child(cells):
        return np.flatnonzero((cells.level == 3) & (cells.ix == 1) & (cells.iy == 1))[0]

    cells = mapper.snapshot()
    at, arm = child(cells), np.sqrt(5.0 * 2.0**2 / 12.0 / 2.0)
    x = cells.x[at] + np.array([arm, -arm, 0.0, 0.0, 0.0])
    y = cells.y[at] + np.array([0.0, 0.0, arm, -arm, 0.0])
    pose = make_pose((8.0, 8.0, 500.0))
    mapper.update(scan(flat(0.6), x, y, pose, 0.0), pose)
    later = mapper.snapshot()
    at = child(later)
    assert later.measured[at]
    assert -later.normal[at, 0] / later.normal[at, 2] == pytest.approx(0.1, abs=0.003)


def test_children_begin_without_a_feature_and_lean_by_a_radian_at_most():
    """However badly the parent's plane fits."""
    leaves = mapped(configured(), flat(), density=60.0, scans=1).leaves
    row, before = np.array([5]), leaves.count
    leaves.feature[row], leaves.feature_covariance[row], leaves.misfit[row] = 1.0, np.eye(5), 100.0
    tilt = leaves.parts[5, 0, 0, 0]
    leaves.divide(row)
    children = np.r_[row, np.arange(before, before + 3)]
    assert np.isnan(leaves.feature[children]).all()
    np.testing.assert_allclose(leaves.parts[children, 0, 0, 0], tilt + 1.0, rtol=1e-6)


def test_a_first_scan_is_all_there_is_to_remember():
    config = configured(lidar={"range_noise": 0.02})
    mapper, rng = Mapper(config), np.random.default_rng(3)
    pose = make_pose((8.0, 8.0, 500.0), pose_covariance(0.1, 1e-9))
    x, y = scattered(rng, 0.0, 0.0, 16.0, 8000)
    seen_from(mapper, block, x, y, pose, -0.2, rng)
    cells = mapper.snapshot()
    assert np.median(cells.z[cells.measured]) == pytest.approx(-0.2, abs=0.01)
