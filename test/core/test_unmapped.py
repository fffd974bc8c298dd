# SPDX-License-Identifier: Apache-2.0
"""Ground that is seen but not yet mapped is as bad as unseen; heights keep to what was measured."""

from dataclasses import replace

import numpy as np
import pytest
from core.builders import configured, mapped, strip
from core.scenes import flat, slope

from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.aim import make_grid
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.core.landing.target import Reason

SIDE = 0.25
CELLS = [(20, 33), (41, 41), (41, 42)]


def limits(assessment="probability", **changes):
    lss = {"assessment": assessment, "grid_spacing": SIDE, **changes}
    return configured(lss={**lss, "dispersion": 0.0}, vehicle={"hazard_growth": 0.0})


@pytest.fixture(scope="module")
def level_ground():
    """16 m of one level, wholly seen and mapped."""
    config = configured(levels=(6, 6), noise=0.01)
    cells = mapped(config, flat(), density=400.0, scans=1).snapshot()
    assert cells.known.all()
    return cells


def without(cells, places):
    """Of the finest cells at rows and columns the returns are not part of the map."""
    known = cells.known.copy()
    known[tuple(np.transpose(places))] = False
    return replace(cells, known=known)


def away(cells, places, found):
    """Distance of the grid points to the nearest of the cells' squares, brute force, m."""
    domain, least = cells.domain, np.full(found.safe.shape, np.inf)
    for row, column in places:
        west, south = domain.xmin + column * SIDE, domain.ymin + row * SIDE
        x = np.maximum(np.maximum(west - found.x, found.x - west - SIDE), 0.0)
        y = np.maximum(np.maximum(south - found.y, found.y - south - SIDE), 0.0)
        least = np.minimum(least, np.hypot(x, y[:, None]))
    return least


@pytest.mark.parametrize("assessment", ["paper", "touchdown", "probability"])
@pytest.mark.parametrize("max_gap", [0.0, 0.6, 5.0])
def test_no_footprint_that_touches_it_is_judged(level_ground, assessment, max_gap):
    """Known all around or not, and however wide the gaps that are bridged."""
    config = limits(assessment, max_gap=max_gap)
    before = LandingSiteSelector(config).assess(level_ground)
    cells = without(level_ground, CELLS)
    found = LandingSiteSelector(config).assess(cells)
    reach = 0.5 * 3.7 + config.vehicle.pad_radius
    touched = away(cells, CELLS, found) < reach - 1e-9
    assert before.safe[touched].any()
    assert not found.safe[touched].any()
    np.testing.assert_array_equal(found.safe[~touched], before.safe[~touched])
    if assessment == "probability":
        assert (found.risk[touched] == 1.0).all()
        assert (found.risk[~touched & before.safe] < 0.01).all()
    corners = away(cells, CELLS, found) < 1e-9
    both = hazards.UNMAPPED | hazards.UNSEEN
    np.testing.assert_array_equal(found.hazard & both == both, corners)
    np.testing.assert_array_equal(np.isnan(found.elevation), found.hazard & both > 0)


def test_gaps_are_bridged_from_known_ground_alone():
    """Of four columns without a return, those beside ground not yet mapped are not firm."""
    cells = strip(4)
    cells = replace(cells, normal=np.where(np.isfinite(cells.normal), (-0.6, 0.0, 0.8), np.nan))
    raster = rasterise(replace(cells, known=cells.known & (np.arange(64) < 34)), LssConfig())
    known = np.arange(64) < 30
    np.testing.assert_array_equal(raster.unestimated.all(axis=0), np.arange(64) >= 34)
    np.testing.assert_array_equal(raster.observed.all(axis=0), np.arange(64) < 32)
    np.testing.assert_array_equal(raster.interior.all(axis=0), known)
    # Heights in the gap are those of the known side.
    np.testing.assert_array_equal(raster.elevation[:, 33], raster.elevation[:, 29])
    np.testing.assert_allclose(raster.slope_x, np.where(known, 0.75, 0.0) * np.ones((64, 1)))


def test_heights_are_lent_by_known_cells_alone(level_ground):
    """Not by a plane that runs on beside them where no point fell."""
    cells = without(level_ground, [(30, 30)])
    observed, known = cells.observed.copy(), cells.known.copy()
    observed[30, 31:33] = known[30, 31:33] = False
    row = cells.leaf_raster()[30, 30:33]
    measured, z = cells.measured.copy(), cells.z.copy()
    measured[row[1]] = False  # between what is not mapped and a plane no point of which is known
    z[row[[0, 2]]] += 9.0
    cells = replace(cells, measured=measured, z=z, observed=observed, known=known)
    raster = rasterise(cells, LssConfig())
    beside = raster.elevation[[29, 31], 31]
    assert raster.elevation[30, 31] in beside and abs(raster.elevation[30, 31]) < 0.1


def test_the_target_is_withdrawn_with_a_word_of_its_own(level_ground):
    selector = LandingSiteSelector(limits())
    selector.assess(level_ground, target=(8.0, 8.0))
    held = selector.assess(level_ground, target=(8.0, 8.0)).selected
    assert held.id
    row, column = (held.position[1::-1] / SIDE).astype(int)
    cells = without(level_ground, [(row, column)])
    found = selector.assess(cells, target=(8.0, 8.0)).selected
    assert found.reason is Reason.UNMAPPED and not found.id


def test_heights_keep_to_what_was_measured_there(level_ground):
    """On a steep plane with bounds, everywhere that a height is taken from it."""
    config = configured(levels=(2, 6))
    cells = mapped(config, slope(0.8, 0.0), density=60.0, scans=1).snapshot()
    low, high = cells.z - 0.4, cells.z + 0.2
    low[::2] = high[1::3] = np.nan
    kept = replace(cells, low=low, high=high)
    rng = np.random.default_rng(7)
    x, y = rng.uniform(0.0, 16.0, (2, 4000))
    side = cells.domain.finest_size
    leaf = cells.leaf_raster()[(y / side).astype(int), (x / side).astype(int)]
    free, found = cells.at(x, y), kept.at(x, y)
    expected = np.fmin(np.fmax(free.height, low[leaf]), high[leaf])
    assert (expected != free.height).mean() > 0.2
    np.testing.assert_array_equal(found.height, expected)
    np.testing.assert_array_equal(found.slope_deg, free.slope_deg)
    raster, plane = rasterise(kept, LssConfig()), rasterise(cells, LssConfig())
    assert kept.measured.all()
    rows = cells.leaf_raster()
    cut = np.fmin(np.fmax(plane.elevation, low[rows]), high[rows])
    known = cells.known
    np.testing.assert_array_equal(raster.elevation[known], cut[known])
    np.testing.assert_array_equal(raster.slope_x, plane.slope_x)
    at = make_grid(cells.domain, 0.5)
    middles = np.clip(at.x, 0.0, 16.0 - 1e-9)
    places = (middles / side).astype(int)
    known = known[places[:, None], places][:-1, :-1]
    heights = kept.at(middles, middles[:, None]).height[:-1, :-1]
    np.testing.assert_allclose(
        at.leaf_elevation(raster)[:-1, :-1][known], heights[known], atol=1e-9
    )
