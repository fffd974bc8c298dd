# SPDX-License-Identifier: Apache-2.0
"""Planes and means of the ground in a disc about each grid point."""

from __future__ import annotations

import numpy as np
import pytest
from core.builders import configured, mapped, slope

from quadtree_lss.onboard.core.landing.lattice import disc, disc_means, ground_planes
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector


def test_beyond_the_edge_the_ground_goes_on():
    """Level, at the height of the edge: half of the disc of a point there has no slope."""
    config = configured(lidar={"range_noise": 0.01})
    cells = mapped(config, slope(0.2, 0.0), density=60.0).snapshot()
    raster = rasterise(cells, 0.6)
    found = ground_planes(raster.elevation, raster.seen, cells.domain.finest_size, 1.5)
    middle = len(found.slope_x) // 2
    assert found.slope_x[middle, middle] == pytest.approx(0.2, abs=0.01)
    assert found.slope_x[middle, 0] == pytest.approx(0.5 * 0.2, abs=0.03)
    assert found.slope_x[middle, -1] == pytest.approx(0.5 * 0.2, abs=0.03)


def test_slope_is_that_of_three_quarters_of_the_landers_radius():
    lander = {"vehicle_diameter": 1.9, "grid_spacing": 0.5}
    config = configured(lidar={"range_noise": 0.03}, domain={"max_level": 5}, lss=lander)

    def waves(x, y):
        return 0.3 * np.sin(1.5 * x) + 0.2 * np.sin(2.0 * y)

    cells = mapped(config, waves, density=60.0).snapshot()
    found = LandingSiteSelector(config).assess(cells)
    side = cells.domain.finest_size
    raster = rasterise(cells, config.lss.max_gap)
    planes = ground_planes(raster.elevation, raster.seen, side, 0.75 * 0.5 * 1.9)
    slope = np.degrees(np.arctan(np.hypot(planes.slope_x, planes.slope_y)))
    np.testing.assert_allclose(found.slope_deg, slope, rtol=1e-12)
    np.testing.assert_array_equal(found.plane_elevation, planes.elevation)


@pytest.mark.parametrize("radius", [0.1, 0.5, 1.3, 2.0])
def test_planes_and_means_are_those_of_the_cells_in_the_disc(radius):
    """Against a least-squares fit to each disc, within the domain."""
    side, n = 0.5, 16
    z = 1000.0 + np.random.default_rng(3).normal(size=(n, n))
    seen = np.ones((n, n), dtype=np.bool_)
    planes, means = ground_planes(z, seen, side, radius), disc_means(z, disc(radius, side), seen)
    row, column = np.indices((n, n))
    for i in range(5, n - 4):
        for j in range(5, n - 4):
            x, y = (column + 0.5 - j) * side, (row + 0.5 - i) * side
            inside = np.hypot(x, y) <= max(radius, 0.75 * side)
            rows = np.column_stack([x[inside], y[inside], np.ones(inside.sum())])
            slope_x, slope_y, high = np.linalg.lstsq(rows, z[inside], rcond=None)[0]
            assert planes.slope_x[i, j] == pytest.approx(slope_x, abs=1e-9)
            assert planes.slope_y[i, j] == pytest.approx(slope_y, abs=1e-9)
            assert planes.elevation[i, j] == pytest.approx(high, abs=1e-9)
            assert means[i, j] == pytest.approx(z[inside].mean(), abs=1e-9)
