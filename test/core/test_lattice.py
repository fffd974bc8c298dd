# SPDX-License-Identifier: Apache-2.0
"""The lattice against brute force: planes and means in discs, distances, values on other grids."""

import numpy as np
import pytest
from core.builders import configured, mapped
from core.scenes import slope
from scipy.ndimage import distance_transform_edt

from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.landing.lattice import (
    dilate,
    disc,
    disc_means,
    distance_from,
    ground_planes,
    nearest_marked,
    steps_to_marked,
)
from quadtree_lss.onboard.core.landing.raster import rasterise


def test_beyond_the_edge_the_ground_goes_on():
    """Level, at the height of the edge: half of the disc of a point there has no slope."""
    config = configured(noise=0.01)
    cells = mapped(config, slope(0.2, 0.0), density=60.0).snapshot()
    raster = rasterise(cells, LssConfig())
    found = ground_planes(raster.elevation, raster.observed, cells.domain.finest_size, 1.5)
    middle = len(found.slope_x) // 2
    assert found.slope_x[middle, middle] == pytest.approx(0.2, abs=0.01)
    assert found.slope_x[middle, 0] == pytest.approx(0.5 * 0.2, abs=0.03)
    assert found.slope_x[middle, -1] == pytest.approx(0.5 * 0.2, abs=0.03)


def test_slope_is_that_of_three_quarters_of_the_landers_radius():
    lander, lss = {"diameter": 1.9}, {"grid_spacing": 0.5}
    noise, finest = {"range_noise": 0.03}, {"max_level": 5}
    config = configured(lidar=noise, domain=finest, vehicle=lander, lss=lss)

    def waves(x, y):
        return 0.3 * np.sin(1.5 * x) + 0.2 * np.sin(2.0 * y)

    cells = mapped(config, waves, density=60.0).snapshot()
    found = LandingSiteSelector(config).assess(cells)
    side = cells.domain.finest_size
    raster = rasterise(cells, config.lss)
    planes = ground_planes(raster.elevation, raster.observed, side, 0.75 * 0.5 * 1.9)
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


def brute(marked: np.ndarray) -> np.ndarray:
    """Distance in steps of every point to the nearest marked one."""
    rows, columns = np.indices(marked.shape)
    out = np.full(marked.shape, np.inf)
    for row, column in np.argwhere(marked):
        out = np.minimum(out, np.sqrt((rows - row) ** 2 + (columns - column) ** 2))
    return out


def some(share: float, shape: tuple[int, int] = (19, 23)) -> np.ndarray:
    return np.random.default_rng(7).random(shape) < share


@pytest.mark.parametrize("share", [0.0, 0.004, 0.05, 0.5, 1.0])
@pytest.mark.parametrize("shape", [(19, 23), (64, 40)])
def test_distances_are_exact(share, shape):
    marked, side = some(share, shape), 0.3
    np.testing.assert_allclose(distance_from(marked, side), side * brute(marked), rtol=1e-15)


@pytest.mark.parametrize("share", [0.004, 0.05, 0.5, 1.0])
@pytest.mark.parametrize("limit", [0.0, 0.3, 1.0, 3.1, 30.0, 37.7, 37.8, 1e300])
@pytest.mark.parametrize("shape", [(19, 23), (64, 40), (300, 200), (1, 9), (9, 1)])
def test_distances_are_exact_up_to_the_limit(share, limit, shape):
    marked, side = some(share, shape), 0.3
    if not marked.any():
        marked[0, 0] = True
    expected, found = distance_from(marked, side), distance_from(marked, side, limit)
    near = expected <= limit
    np.testing.assert_array_equal(found[near], expected[near])
    assert (found[~near] > limit).all()


@pytest.mark.parametrize("share", [0.004, 0.05, 0.5, 1.0])
def test_the_place_is_that_which_scipy_finds(share):
    marked = some(share)
    found = distance_transform_edt(~marked, return_distances=False, return_indices=True)
    expected = np.ravel_multi_index(tuple(found), marked.shape)
    np.testing.assert_array_equal(nearest_marked(marked.view(np.uint8)), expected)


@pytest.mark.parametrize("share", [0.0, 0.004, 0.05, 1.0])
@pytest.mark.parametrize("distance", [0.0, 0.29, 0.3, 0.6, 1.0, 3.7, 4.8, 5.1, 6.3, 50.0, 1e300])
def test_growth_takes_what_is_within_the_distance(share, distance):
    marked, side = some(share), 0.3
    expected = brute(marked) * side <= distance
    np.testing.assert_array_equal(dilate(marked, distance, side), expected)


@pytest.mark.parametrize("half", [0.0, 0.5])
@pytest.mark.parametrize("share", [0.0, 0.0005, 0.05, 1.0])
@pytest.mark.parametrize("limit", [0.5, 7.0, 60.0])
def test_distance_of_a_point_is_exact_up_to_the_limit(half, share, limit):
    marked, rng = some(share, (70, 90)), np.random.default_rng(5)
    row, column = np.nonzero(marked)
    for x, y in [(0.0, 0.0), (90.0, 70.0), (4.0, 3.0), *rng.uniform(0.0, 70.0, (40, 2))]:
        dx = np.maximum(np.abs(x - column - half) - half, 0.0)
        dy = np.maximum(np.abs(y - row - half) - half, 0.0)
        expected = np.min(np.hypot(dx, dy), initial=np.inf)
        found = steps_to_marked(marked.view(np.uint8), half, x, y, limit)
        assert found == pytest.approx(min(expected, limit), abs=1e-12)
