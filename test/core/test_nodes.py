# SPDX-License-Identifier: Apache-2.0
"""Planes of the nodes: the mean slope of the ground in a disc about each."""

from __future__ import annotations

import numpy as np
import pytest
from core.builders import configured, mapped, slope

from quadtree_lss.core.landing import hazards
from quadtree_lss.core.landing.nodes import node_planes
from quadtree_lss.core.landing.raster import rasterise
from quadtree_lss.core.landing.score import assess_nodes
from quadtree_lss.core.landing.touchdown import TouchdownCheck


def test_beyond_the_edge_the_ground_goes_on():
    """Level, at the height of the edge: half of the disc of a node there has no slope."""
    config = configured(lidar={"range_noise": 0.01})
    cells = mapped(config, slope(0.2, 0.0), density=60.0).snapshot()
    found = node_planes(rasterise(cells, 0.6), 1.5)
    middle = len(found.slope_x) // 2
    assert found.slope_x[middle, middle] == pytest.approx(0.2, abs=0.01)
    assert found.slope_x[middle, 0] == pytest.approx(0.5 * 0.2, abs=0.03)
    assert found.slope_x[middle, -1] == pytest.approx(0.5 * 0.2, abs=0.03)


def test_slope_is_that_of_three_quarters_of_the_landers_radius():
    lander = {"vehicle_diameter": 1.9}
    config = configured(lidar={"range_noise": 0.03}, domain={"max_level": 5}, lss=lander)

    def waves(x, y):
        return 0.3 * np.sin(1.5 * x) + 0.2 * np.sin(2.0 * y)

    cells = mapped(config, waves, density=60.0).snapshot()
    raster, lss = rasterise(cells, config.lss.max_gap), config.lss
    nodes = assess_nodes(cells, raster, lss, hazards.LeafHazards(lss), TouchdownCheck(lss))
    expected = node_planes(raster, 0.75 * 0.5 * 1.9)
    np.testing.assert_array_equal(nodes.planes.slope_x, expected.slope_x)
    np.testing.assert_array_equal(nodes.planes.slope_y, expected.slope_y)
