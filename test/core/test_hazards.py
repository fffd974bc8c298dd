# SPDX-License-Identifier: Apache-2.0
"""Avoided features of leaves and the raster that landing assessment reads."""

from dataclasses import replace
from unittest import mock

import numpy as np
import pytest
from core.builders import configured, feature_height, mapped, strip
from core.scenes import flat

from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.core.tree.ancestors import fuse_to_level
from quadtree_lss.onboard.core.tree.cell_map import CellMap


def terrain(x, y):
    """A step, a block, and a 12-degree slope in the north-east."""
    step = 0.4 * (x > 5.1)
    block = 0.5 * ((np.abs(x - 3.0) < 0.5) & (np.abs(y - 3.0) < 0.5))
    return step + block + np.tan(np.radians(12.0)) * np.maximum(y - 10.0, 0.0) * (x > 9.0)


@pytest.fixture(scope="module")
def cells() -> CellMap:
    config = configured(noise=0.03)
    return mapped(config, terrain, density=120.0, scans=2).snapshot()


def test_bits_follow_the_tolerances(cells):
    """The elevation against a grid of samples over each leaf, distance along the normal of the
    fused plane of 4 m cells."""
    config = configured(vehicle={"max_slope_deg": 5.0, "clearance": 0.15}).lss
    with mock.patch.object(hazards, "MAX_EXCEPTION_FRACTION", 0.01):
        bits = hazards.avoided_features(cells, config)
    own, level = cells.measured, int(np.log2(cells.domain.size / 4.0))
    expected = np.degrees(np.arccos(np.minimum(cells.normal[:, 2], 1.0))) > 5.0
    np.testing.assert_array_equal((bits & hazards.SLOPE > 0), expected & own)
    often = np.nan_to_num(cells.exception_fraction) > 0.01
    np.testing.assert_array_equal((bits & hazards.EXCEPTION > 0), often & own)
    fused = fuse_to_level(cells, level)
    steps = np.linspace(-0.5, 0.5, 5)
    for k in range(len(cells.z)):
        a, off = fused.of_leaf[k], 0.0
        if cells.level[k] > level and a >= 0:
            dx, dy = (v.ravel() * cells.size[k] for v in np.meshgrid(steps, steps))
            n = cells.normal[k]
            z = cells.z[k] - (n[0] * dx + n[1] * dy) / n[2]
            points = np.column_stack([cells.x[k] + dx, cells.y[k] + dy, z])
            off = np.abs((points - fused.planes[a, :3]) @ fused.planes[a, 3:]).max()
        assert bool(bits[k] & hazards.ELEVATION) == (own[k] and off > 0.15)


def test_raster_is_the_leaf_planes_at_the_finest_centres(cells):
    raster = rasterise(cells, LssConfig())
    n, side = cells.domain.finest_count, cells.domain.finest_size
    leaf = cells.leaf_raster()
    np.testing.assert_array_equal(raster.leaf, leaf)
    rng = np.random.default_rng(2)
    for row, column in rng.integers(0, n, (300, 2)):
        k = leaf[row, column]
        if not cells.measured[k]:
            continue
        dx, dy = (column + 0.5) * side - cells.x[k], (row + 0.5) * side - cells.y[k]
        normal = cells.normal[k]
        expected = cells.z[k] - (normal[0] * dx + normal[1] * dy) / normal[2]
        expected = np.clip(expected, cells.low[k], cells.high[k])
        assert raster.elevation[row, column] == pytest.approx(expected, abs=1e-9)
        assert raster.slope_x[row, column] == pytest.approx(-normal[0] / normal[2], abs=1e-12)


@pytest.mark.parametrize("place", [(0.031, -0.12), (0.6, 0.7), (-0.99, 0.99)])
def test_subscale_is_the_mean_and_the_greatest_height_within_the_cell(place):
    """Against a fine sampling; wherever on the lattice it lies, a feature has its full peak and its
    volume."""
    config = configured(levels=(3, 6), noise=0.01)
    cells = mapped(config, flat(), density=50.0, scans=1).snapshot()
    k = int(np.flatnonzero((cells.x == 5.0) & (cells.y == 7.0))[0])
    cells.feature[:] = np.nan
    cells.feature[k] = (0.0, np.sqrt(0.3 * 2.0 * np.pi) * 0.15, *place, 0.15)
    raster = rasterise(cells, LssConfig())
    side = cells.domain.finest_size
    assert raster.subscale_peak.max() == pytest.approx(0.3, rel=1e-9)
    fine = (np.arange(25) + 0.5) / 25.0 * side
    for row in range(24, 32):
        for column in range(16, 24):
            dx, dy = column * side + fine - cells.x[k], row * side + fine - cells.y[k]
            sampled = feature_height(cells.feature[k], dx, dy[:, None])
            assert raster.subscale[row, column] == pytest.approx(sampled.mean(), abs=1e-3)
            if sampled.max() > 0.006:
                assert raster.subscale_peak[row, column] == pytest.approx(sampled.max(), abs=0.01)
    # Tails of millimetres are no feature, and other leaves have none.
    assert raster.subscale_peak[raster.subscale_peak > 0.0].min() >= 0.005
    for layer in (raster.subscale, raster.subscale_peak):
        assert not np.delete(layer, np.s_[16:24], axis=1).any()


@pytest.mark.parametrize(
    ("columns", "gap", "unseen"),
    [(1, 0.6, []), (4, 0.6, []), (5, 0.6, [32]), (5, 0.65, []), (7, 0.6, [32, 33, 34])],
)
def test_ground_within_the_gap_of_an_observed_cell_is_seen(columns, gap, unseen):
    """Centres lie 0.125, 0.375, 0.625 m ... from the nearest observed cell's edge."""
    raster = rasterise(strip(columns), LssConfig(max_gap=gap))
    assert np.flatnonzero(~raster.observed.all(axis=0)).tolist() == unseen
    assert np.isfinite(raster.elevation).all()
    # Gaps are bridged whole or not at all.
    missing = list(range(30, 30 + columns)) if unseen else []
    assert np.flatnonzero(~raster.interior.all(axis=0)).tolist() == missing


@pytest.mark.parametrize(("returns", "unseen"), [(5.9, []), (6.1, [30, 31, 32, 33])])
def test_a_gap_among_many_independent_returns_is_a_shadow(returns, unseen):
    """Its ground may lie behind a drop, so it is unseen, however narrow the gap. Of ``returns`` at
    random places of a cell, each of its 16 parts is missed with a chance of exp(-returns / 16)."""
    cells = strip(4)
    covered = np.full(len(cells.level), 1.0 - np.exp(-returns / 16.0))
    many = replace(cells, count=np.full_like(cells.count, 1000), coverage=covered)
    raster = rasterise(many, LssConfig())
    for bridged in (raster.observed, raster.interior):
        assert np.flatnonzero(~bridged.all(axis=0)).tolist() == unseen
