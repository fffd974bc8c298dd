# SPDX-License-Identifier: Apache-2.0
"""How much of the ground returns fell on: the same places seen again tell nothing new."""

import numpy as np
import pytest
from core.builders import configured, disturbed, flat, look
from core.scenes import make_pose, scan, scattered

from quadtree_lss.onboard.core.landing.raster import independent_returns, rasterise
from quadtree_lss.onboard.core.mapping.mapper import Mapper

CONFIG = configured(noise=0.02)
GROUND = flat()


def returns(mapper):
    """Of each finest cell, as landing counts them."""
    raster = rasterise(mapper.snapshot(), CONFIG.lss)
    return raster.returns[raster.leaf]


def test_coverage_is_the_share_of_parts_with_a_return():
    rng = np.random.default_rng(3)
    mapper = Mapper(CONFIG)
    x, y = scattered(rng, 0.0, 0.0, 16.0, 9000)
    for _ in range(2):
        look(mapper, GROUND, x, y, rng, 0.02)
    cells = mapper.snapshot()
    n = cells.domain.finest_count
    parts = np.zeros((4 * n, 4 * n), dtype=bool)
    parts[(y / 16.0 * 4 * n).astype(int), (x / 16.0 * 4 * n).astype(int)] = True
    hit = parts.reshape(n, 4, n, 4).mean(axis=(1, 3))
    raster = cells.leaf_raster()
    shares = [hit[(raster == leaf) & cells.known].mean() for leaf in range(len(cells.level))]
    np.testing.assert_allclose(cells.coverage, shares, atol=0.03)  # a ray ends beside its place


@pytest.mark.parametrize("count", [1, 4, 12, 30])
def test_returns_follow_from_how_much_they_cover(count):
    rng = np.random.default_rng(4)
    thrown = rng.integers(0, 16, (20000, count))
    covered = (np.bincount((thrown + 16 * np.arange(20000)[:, None]).ravel()) > 0).sum()
    assert independent_returns(np.array([covered / 320000.0]))[0] == pytest.approx(count, rel=0.06)
    assert independent_returns(np.array([1.0]))[0] == np.inf


def test_views_that_repeat_add_no_returns():
    """A hover: the same rays thirty times count as once, other rays as often as they are."""
    x, y = scattered(np.random.default_rng(5), 0.0, 0.0, 16.0, 12000)
    counts = []
    for views in (1, 30):
        rng, mapper = np.random.default_rng(6), Mapper(CONFIG)
        for _ in range(views):
            look(mapper, GROUND, x, y, rng, 0.02)
        counts.append(np.median(returns(mapper)))
    other = Mapper(CONFIG)
    rng = np.random.default_rng(7)
    for _ in range(6):
        look(other, GROUND, *scattered(rng, 0.0, 0.0, 16.0, 12000), rng, 0.02)
    once, again = counts
    assert again < 1.3 * once
    assert np.median(returns(other)) > 4.0 * once


@pytest.mark.parametrize("attitude", [1e-6, 0.002])
def test_pose_errors_of_a_hover_add_no_returns(attitude):
    """A lidar that moves by more than its pose errors adds returns."""
    x, y = scattered(np.random.default_rng(8), -8.0, -8.0, 32.0, 36000)
    covariance = np.diag([1e-8] * 3 + [attitude**2] * 3)
    covariance.setflags(write=False)
    config = configured(noise=0.02, pose={"correlation_time": 0.0})
    counts = []
    for views, step in ((1, 0.0), (12, 0.0), (12, 0.6)):
        rng, mapper = np.random.default_rng(9), Mapper(config)
        for k in range(views):
            move = np.array([step * k, 0.5 * step * k, 0.0])
            pose = make_pose(tuple(move + (8.0, 8.0, 60.0)), covariance)
            beams = scan(GROUND, x + move[0], y + move[1], pose, 0.02, rng)
            mapper.update(beams, disturbed(pose, rng))
        counts.append(np.median(returns(mapper)))
    once, still, moving = counts
    assert 0.9 * once < still < 1.1 * once < 0.5 * moving
