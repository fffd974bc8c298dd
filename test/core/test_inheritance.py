# SPDX-License-Identifier: Apache-2.0
"""What children inherit: a leaf that divides does not forget what earlier scans said of it."""

import numpy as np
import pytest
from core.builders import configured, divide, leaf_at, look, mapped
from core.scenes import ABOVE, flat, make_pose, pose_covariance, scan, scattered

from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose

INDEPENDENT = {"correlation_time": 0.0}
POSE = make_pose(ABOVE, pose_covariance(0.1, 1e-9))


def block(x, y):
    """Level ground with one block of half a metre."""
    return np.where((np.abs(x - 5.0) < 0.5) & (np.abs(y - 5.0) < 0.5), 0.5, 0.0)


def test_children_keep_the_mean_height_of_all_scans():
    config = configured(noise=0.02, pose=INDEPENDENT)
    mapper, rng = Mapper(config), np.random.default_rng(2)
    for high in (0.1, 0.1, 0.1):
        look(mapper, flat(), *scattered(rng, 0.0, 0.0, 16.0, 8000), rng, 0.02, POSE, high)
    leaves = mapper.leaves.count
    look(mapper, block, *scattered(rng, 0.0, 0.0, 16.0, 8000), rng, 0.02, POSE, -0.2)
    cells = mapper.snapshot()
    assert len(cells.level) > leaves
    divided = cells.measured & (cells.level > config.domain.min_level)
    beside = np.maximum(np.abs(cells.x - 5.0), np.abs(cells.y - 5.0)) > 0.5 + 0.5 * cells.size
    # Four scans of equal covariance: (3 * 0.1 - 0.2) / 4, not the -0.2 of the scan that divides.
    # The block, which only that scan saw, lifts its fit of the 4 m leaf by 0.5 m / 16.
    np.testing.assert_allclose(np.median(cells.z[divided & beside]), 0.025, atol=0.04)


@pytest.mark.parametrize("correlation_time", [0.0, 300.0])
def test_children_keep_the_pose_part_of_all_scans(correlation_time):
    config = configured(noise=0.02, pose={"correlation_time": correlation_time})
    mapper, rng = Mapper(config), np.random.default_rng(2)
    for surface in (flat(), flat(), flat(), block):
        look(mapper, surface, *scattered(rng, 0.0, 0.0, 16.0, 8000), rng, 0.02, POSE)
    cells = mapper.snapshot()
    divided = cells.measured & (cells.level > config.domain.min_level)
    assert divided.any()
    # Four scans of 0.1 m each: 0.01 m^2 / 4, not the 0.01 m^2 of the scan that divides; of one
    # error that lasts, 0.01 m^2.
    expected = 0.01 if correlation_time else 0.0025
    np.testing.assert_allclose(cells.covariance_pose[divided, 2, 2], expected, rtol=0.3)


@pytest.mark.parametrize("part", ["strip", "corner"])
def test_a_part_of_a_known_leaf_moves_its_middle_by_no_more_than_its_points(part):
    """200 points 0.3 m high in a tenth of a leaf that is known from 3,000."""
    config = configured(levels=(2, 2), noise=0.05)
    mapper, rng = mapped(config, flat(), density=60.0, scans=3), np.random.default_rng(5)
    before = leaf_at(mapper, 6.0, 6.0).copy()
    x = 4.0 + 0.4 * rng.random(200)
    y = 4.0 + (0.4 if part == "corner" else 4.0) * rng.random(200)
    look(mapper, flat(0.3), x, y, rng, 0.05, make_pose(ABOVE, stamp_ns=10))
    after = leaf_at(mapper, 6.0, 6.0)
    assert abs(after.z - before.z) < 0.3 * 200.0 / after.points
    # Held against the plane, beyond what either may be off, they stand out.
    assert after.distance_sum - after.noise_sum > 100.0 * 0.15
    # So thin a part tells no slope: that is the one before, to the bit.
    np.testing.assert_array_equal(after.normal, before.normal)


@pytest.mark.parametrize("towards", [1.0, -1.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_scan_that_is_off_sideways_does_not_outvote_what_children_inherit(seed, towards):
    """A roof, seen ten times; half its leaves divide, then one scan 0.5 m off along x, as claimed.

    On either side of the roof it is 0.2 m off, one up and one down: no height takes that out. The
    mean of the ten, less certain by 6 cm, weighs ten times as much.
    """
    config = configured(noise=0.05, pose=INDEPENDENT)
    mapper, rng = Mapper(config), np.random.default_rng(seed)

    def roof(x, y):
        return -0.4 * np.abs(x - 8.0)

    pose = make_pose((8.0, 8.0, 500.0), pose_covariance(0.5, 1e-9))
    for k in range(11):
        if k == 10:
            for row in (0, 2, 5, 7, 8, 10, 13, 15):
                divide(mapper.leaves, row, 0.06**2, 1e-4)
        x, y = scattered(rng, 0.0, 0.0, 16.0, 8000)
        off = (0.5 * towards if k == 10 else 0.0, 0.0, 0.0)
        rotation, sigma = pose.rotation_map_lidar, pose.covariance
        true = Pose(k + 1, pose.position - off, rotation, sigma)
        estimate = Pose(k + 1, pose.position, rotation, sigma)
        mapper.update(scan(roof, x - off[0], y, true, 0.05, rng), estimate)
    cells = mapper.snapshot()
    inner = (cells.level == 3) & (np.abs(cells.x - 8.0) > 4.0)
    assert inner.sum() >= 12 and cells.measured[inner].all()
    error = cells.z[inner] - roof(cells.x[inner], cells.y[inner])
    assert np.abs(error).max() < 0.04
