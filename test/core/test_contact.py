# SPDX-License-Identifier: Apache-2.0
"""Contacts against a brute-force computation, and their incremental update against a new one."""

import dataclasses
import itertools

import numpy as np
import pytest
from core.builders import configured, mapped, with_lengths
from hypothesis import given
from hypothesis import strategies as st

from quadtree_lss.onboard.config.limits import YAWS
from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.landing.contact import ContactCheck, ContactLimits, Contacts
from quadtree_lss.onboard.core.landing.raster import TerrainRaster, rasterise
from quadtree_lss.onboard.core.tree.cell_map import SHAPE

#: 16 x 16 finest cells of 0.5 m.
SMALL = {"size": 8.0, "min_level": 1, "max_level": 4}
LAYERS = ("elevation", "slope_x", "slope_y", "subscale")
EXACT = ContactLimits(-10.0, 10.0)


def vehicle(diameter: float) -> Config:
    return configured(domain=SMALL, noise=0.02, vehicle={"diameter": diameter})


@pytest.fixture(scope="module")
def empty() -> TerrainRaster:
    config = vehicle(2.9)
    cells = mapped(config, lambda x, y: 0.0 * x, density=50.0, scans=1).snapshot()
    return rasterise(cells, config.lss)


def uneven(raster: TerrainRaster, seed: int, level: float = 0.0) -> TerrainRaster:
    """The raster with random ground: heights, slopes and features of each cell."""
    rng, shape = np.random.default_rng(seed), raster.elevation.shape
    x, y = rng.normal(0.0, 0.1, (2, *shape))
    z = level + rng.normal(0.0, 0.1, shape) + 0.05 * np.arange(shape[1])
    subscale = 0.2 * (rng.random(shape) < 0.1)
    layers = dict(zip(LAYERS, (z, x, y, subscale), strict=True))
    return dataclasses.replace(raster, **layers)


def inside(raster: TerrainRaster, diameter: float) -> np.ndarray:
    """Grid points whose circle of pads lies inside the domain."""
    n, side = raster.domain.finest_count, raster.domain.finest_size
    along = np.minimum(np.arange(n + 1), np.arange(n, -1, -1)) * side >= 0.5 * diameter
    return along & along[:, None]


def brute_force(
    raster: TerrainRaster, config: Config, headings: np.ndarray, row: int, column: int
) -> tuple[float, float]:
    """Rise and tilt at a grid point: every heading, plane and cell, with solved planes."""
    n, side, radius = raster.elevation.shape[0], raster.domain.finest_size, config.vehicle.diameter
    radius *= 0.5
    centre = (np.arange(n) + 0.5) * side
    v, u = np.meshgrid(centre - row * side, centre - column * side, indexing="ij")
    top = raster.elevation + SHAPE * raster.subscale
    top = top + 0.5 * side * (np.abs(raster.slope_x) + np.abs(raster.slope_y))
    under = np.hypot(u, v) <= max(radius, 0.75 * side)
    rise, tilt = -np.inf, 0.0
    for yaw in headings:
        c, s = np.cos(yaw), np.sin(yaw)
        pads = []
        for x, y in radius * np.array([(c, s), (-s, c), (-c, -s), (s, -c)]):
            # A pad on a border belongs to the cell north-east of it, or outside to the last one.
            i, j = row + int(np.floor(y / side)), column + int(np.floor(x / side))
            from_x, from_y = x - (j - column + 0.5) * side, y - (i - row + 0.5) * side
            i, j = min(i, n - 1), min(j, n - 1)
            slope = raster.slope_x[i, j], raster.slope_y[i, j]
            z = raster.elevation[i, j] + config.vehicle.pad_radius * np.hypot(*slope)
            pads.append((x, y, z + slope[0] * from_x + slope[1] * from_y))
        first = 0 if pads[0][2] + pads[2][2] >= pads[1][2] + pads[3][2] else 1
        for third in (first + 1, (first + 3) % 4):
            three = np.array([pads[first], pads[first + 2], pads[third]])
            x, y, z = np.linalg.solve(np.column_stack([three[:, :2], np.ones(3)]), three[:, 2])
            tilt = max(tilt, float(np.hypot(x, y)))
            rise = max(rise, float((top - z - x * u - y * v)[under].max()))
    return rise, tilt


# Of the diameters one is smaller than a cell, and two put pads on borders of cells.
@pytest.mark.parametrize("diameter", [0.4, 2.0, 2.9, 4.0])
@pytest.mark.parametrize("heading", [None, 0.3])
@pytest.mark.parametrize("seed", range(3))
def test_contacts_are_those_of_a_brute_force_computation(empty, diameter, heading, seed):
    config, raster = vehicle(diameter), uneven(empty, seed, level=1000.0 * seed)
    needed = inside(raster, diameter)
    found = ContactCheck(config.lss, EXACT).contacts(raster, needed, heading)
    headings = np.arange(YAWS) * 0.5 * np.pi / YAWS if heading is None else np.array([heading])
    for row, column in np.argwhere(needed)[::3]:
        rise, tilt = brute_force(raster, config, headings, row, column)
        assert found.rise[row, column] == pytest.approx(rise, abs=1e-6)
        assert found.tilt[row, column] == pytest.approx(tilt, abs=1e-6)
    assert np.isnan(found.rise[~needed]).all()
    assert np.isnan(found.tilt[~needed]).all()


def test_limits_replace_only_the_contacts_beyond_them(empty):
    config, raster = vehicle(2.9), uneven(empty, 5)
    needed = inside(raster, 2.9)
    exact = ContactCheck(config.lss, EXACT).contacts(raster, needed)
    limits = ContactLimits(*(float(np.nanmedian(v)) for v in (exact.rise, exact.tilt)))
    found = ContactCheck(config.lss, limits).contacts(raster, needed)
    np.testing.assert_array_equal(found.tilt, exact.tilt)
    least = np.float32(limits.min_rise)
    expected = np.where(exact.tilt > limits.max_tilt, least, np.maximum(exact.rise, least))
    np.testing.assert_array_equal(found.rise[needed], expected[needed])


def assert_same(found: Contacts, expected: Contacts) -> None:
    np.testing.assert_array_equal(found.rise, expected.rise)
    np.testing.assert_array_equal(found.tilt, expected.tilt)


CELL = st.tuples(*[st.one_of(st.integers(0, 15), st.sampled_from([0, 15]))] * 2)


@given(
    seed=st.integers(0, 1000),
    diameter=st.sampled_from([0.4, 2.0, 2.9, 4.0]),
    changes=st.lists(
        st.tuples(st.sampled_from(LAYERS), CELL, st.tuples(st.integers(1, 4), st.integers(1, 16))),
        min_size=1,
        max_size=4,
    ),
)
def test_an_update_equals_a_new_computation_whatever_cells_change(empty, seed, diameter, changes):
    config, raster = vehicle(diameter), uneven(empty, seed)
    rng, everywhere = np.random.default_rng(seed), inside(raster, diameter)
    following = ContactCheck(config.lss, EXACT)
    for layer, (row, column), (high, wide) in changes:
        values = getattr(raster, layer).copy()
        values[row : row + high, column : column + wide] += rng.uniform(0.1, 1.0)
        raster = dataclasses.replace(raster, **{layer: values})
        needed = everywhere & (rng.random(everywhere.shape) < 0.7)
        new = ContactCheck(config.lss, EXACT).contacts(raster, needed)
        assert_same(following.contacts(raster, needed), new)


@pytest.mark.parametrize("edge", [np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]])
@pytest.mark.parametrize("diameter", [2.9, 4.0])
def test_contacts_follow_a_change_of_a_border_row_or_column(empty, edge, diameter):
    """Pads stand on these cells where the vehicle just fits into the domain."""
    config, raster = vehicle(diameter), uneven(empty, 7)
    needed = inside(raster, diameter)
    following = ContactCheck(config.lss, EXACT)
    before = following.contacts(raster, needed)
    elevation = raster.elevation.copy()
    elevation[edge] += 0.5
    raster = dataclasses.replace(raster, elevation=elevation)
    after = following.contacts(raster, needed)
    assert_same(after, ContactCheck(config.lss, EXACT).contacts(raster, needed))
    assert (after.rise[needed] != before.rise[needed]).any()


@pytest.mark.parametrize("moved", [(1, 0), (-3, 2), (0, -5), (40, 0)])
@pytest.mark.parametrize("diameter", [2.9, 4.0])
def test_a_domain_that_moves_keeps_contacts_that_equal_new_ones(empty, moved, diameter):
    config, raster = vehicle(diameter), uneven(empty, 3)
    needed, domain = inside(raster, diameter), raster.domain
    following = ContactCheck(config.lss, EXACT)
    following.contacts(raster, needed)
    east, north = (steps * domain.finest_size for steps in moved)
    domain = dataclasses.replace(domain, xmin=domain.xmin + east, ymin=domain.ymin + north)
    layers = {
        name: np.roll(getattr(raster, name), (-moved[1], -moved[0]), (0, 1)) for name in LAYERS
    }
    raster = dataclasses.replace(raster, domain=domain, **layers)
    new = ContactCheck(config.lss, EXACT).contacts(raster, needed)
    assert_same(following.contacts(raster, needed), new)


@pytest.mark.parametrize(
    ("growth", "reach"), [(0.0, 0.0), (0.25, 0.5), (0.5, 0.5), (0.8, 1.0), (1.3, 1.5)]
)
def test_unsafe_ground_grows_by_the_set_length_rounded_outwards(growth, reach):
    """Grid points lie 0.5 m apart, so any growth reaches at least the next one."""
    lss = {"assessment": "touchdown", "grid_spacing": 0.5}
    lander = {"diameter": 2.9, "hazard_growth": 0.0}
    config = configured(domain=SMALL, noise=0.02, vehicle=lander, lss=lss)

    def ground(x, y):
        return 0.5 * ((np.abs(x - 3.3) < 0.5) & (np.abs(y - 4.8) < 0.5))

    cells = mapped(config, ground, density=150.0, scans=1).snapshot()
    bare, grown = (
        LandingSiteSelector(one).assess(cells).hazard & hazards.TOUCHDOWN > 0
        for one in (config, with_lengths(config, hazard_growth=growth))
    )
    unsafe = np.argwhere(bare)
    assert len(unsafe)
    inner = range(3, 14)  # The vehicle fits into the domain.
    for row, column in itertools.product(inner, inner):
        distance = cells.domain.finest_size * np.hypot(*(unsafe - (row, column)).T).min()
        assert grown[row, column] == (distance <= reach)
