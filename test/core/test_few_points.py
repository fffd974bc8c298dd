# SPDX-License-Identifier: Apache-2.0
"""Cells that get one or two points a scan: stored until they make a plane, heights after that."""

from __future__ import annotations

import numpy as np
import pytest
from core.builders import (
    configured,
    flat,
    lattice,
    make_pose,
    pose_covariance,
    scan,
    scattered,
    slope,
)

from quadtree_lss.core.mapping.mapper import Mapper
from quadtree_lss.core.sensing.lidar import Pose

FINEST_1M = {"min_level": 4, "max_level": 4}
CELLS_4M = {"min_level": 2, "max_level": 2}
ABOVE = (8.0, 8.0, 500.0)
TWO = np.array([1.0, 3.0])


def test_stored_points_go_up_with_the_map():
    """Two scans in three are 0.4 m too high; the corner's cell gets two points of each."""
    config = configured(domain=FINEST_1M, lidar={"range_noise": 0.01})
    rng, mapper = np.random.default_rng(1), Mapper(config)
    estimate = make_pose(ABOVE, pose_covariance(0.3, 1e-9))
    for number, error in enumerate((0.0, 0.4, 0.4)):
        x, y = scattered(rng, 0.0, 0.0, 16.0, 12_000)
        rest = (x > 1.1) | (y > 1.1)
        x = np.r_[x[rest], 0.1 + 0.2 * number, 0.9]
        y = np.r_[y[rest], 0.1, 0.9 - 0.3 * number]
        position = estimate.position - (0.0, 0.0, error)
        true = Pose(1, position, estimate.rotation_map_lidar, estimate.covariance)
        mapper.update(scan(flat(), x, y, true, 0.01, rng), estimate)
        cells = mapper.snapshot()
        corner = np.flatnonzero((cells.ix == 0) & (cells.iy == 0))[0]
        assert cells.measured[corner] == (number == 2)
    assert cells.count[corner] == 6
    assert cells.z[corner] == pytest.approx(np.median(cells.z), abs=0.03)


def test_stored_points_far_from_the_frames_origin():
    """Two points a cell and scan, fitted together: 20 km away the same."""
    maps = []
    for at in (np.zeros(3), np.array([20_000.0, -20_000.0, 3_000.0])):
        config = configured(
            domain={"xmin": float(at[0]), "ymin": float(at[1]), **FINEST_1M},
            lidar={"range_noise": 0.03},
        )
        rng, mapper = np.random.default_rng(4), Mapper(config)
        for k in range(5):
            place = np.array([-180.0, 8.0 + 20.0 * k, 120.0])
            pose = make_pose(tuple(place + at), pose_covariance(0.1, 1e-4), k + 1)
            x, y = scattered(rng, 0.0, 0.0, 16.0, 512)
            local = scan(slope(0.1, 0.05), x, y, make_pose(tuple(place)), 0.03, rng)
            mapper.update(local, pose)
        maps.append(mapper.snapshot())
    one, other = maps
    assert one.measured.sum() > 50
    np.testing.assert_array_equal(one.measured, other.measured)
    np.testing.assert_allclose(other.covariance, one.covariance, rtol=1e-3, atol=1e-9)


def test_two_points_more_are_counted_and_weigh_two():
    config = configured(domain=CELLS_4M, lidar={"range_noise": 0.05})
    rng, pose, mapper = np.random.default_rng(3), make_pose(ABOVE), Mapper(config)
    x, y = lattice(0.0, 0.0, 4.0, 5)
    mapper.update(scan(flat(), x, y, pose, 0.05, rng), pose)
    before = mapper.snapshot()
    mapper.update(scan(flat(), TWO, TWO, pose, 0.0), pose)
    after = mapper.snapshot()
    (cell,) = np.flatnonzero(before.measured)
    assert after.count[cell] == before.count[cell] + 2
    own, two = before.covariance_range[cell, 2, 2], 0.05**2 / 2.0
    assert after.covariance_range[cell, 2, 2] == pytest.approx(own * two / (own + two), rel=0.02)


def test_two_points_more_keep_the_papers_treatment():
    """Pose error independent from point to point is range noise: no pose part of it."""
    values = {"covariance": "independent", "align": False}
    config = configured(domain=CELLS_4M, mapping=values)
    rng, mapper = np.random.default_rng(3), Mapper(config)
    pose = make_pose(ABOVE, pose_covariance(0.3, 1e-6))
    x, y = lattice(0.0, 0.0, 4.0, 5)
    mapper.update(scan(flat(), x, y, pose, 0.05, rng), pose)
    mapper.update(scan(flat(), TWO, TWO, pose, 0.0), pose)
    cells = mapper.snapshot()
    assert cells.count[cells.measured] == 27
    assert np.abs(cells.covariance_pose[cells.measured]).max() < 1e-12
