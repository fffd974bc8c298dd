# SPDX-License-Identifier: Apache-2.0
"""A leaf that divides does not forget what earlier scans said of its height."""

from __future__ import annotations

import numpy as np
import pytest
from core.builders import configured, make_pose, pose_covariance, scan, scattered

from quadtree_lss.core.lidar import Pose
from quadtree_lss.core.mapping import Mapper


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


def test_a_first_scan_is_all_there_is_to_remember():
    config = configured(lidar={"range_noise": 0.02})
    mapper, rng = Mapper(config), np.random.default_rng(3)
    pose = make_pose((8.0, 8.0, 500.0), pose_covariance(0.1, 1e-9))
    x, y = scattered(rng, 0.0, 0.0, 16.0, 8000)
    seen_from(mapper, block, x, y, pose, -0.2, rng)
    cells = mapper.snapshot()
    assert np.median(cells.z[cells.measured]) == pytest.approx(-0.2, abs=0.01)
