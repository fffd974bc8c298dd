# SPDX-License-Identifier: Apache-2.0
"""Map and site messages: what is float64 comes back exactly, damage is refused."""

import dataclasses
import tracemalloc

import numpy as np
import pytest
from core.builders import assert_same, configured, mapped
from fuzz.cases import Types

from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.tree.cell_map import CellMap
from quadtree_lss.onboard.messages import maps
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.outputs import GRID_TYPE, TOPIC_TYPES, MessageMaker

EXACT = ("level", "ix", "iy", "z", "normal", "count", "measured", "observed", "known")
EXACT += ("low", "high")
SINGLE = ("covariance_range", "covariance_pose", "roughness", "exception_fraction", "feature")


@pytest.fixture(scope="module")
def cells() -> CellMap:
    """A map with steps, holes, features and inherited cells."""
    config = configured(domain={"xmin": -7.3, "ymin": 102.4})

    def terrain(x, y):
        rock = np.sqrt(np.maximum(0.3**2 - (x - 1.0) ** 2 - (y - 110.0) ** 2, 0.0))
        return 40.0 + 0.5 * (x > 3.0) + rock

    found = mapped(config, terrain, density=60.0, where=(-7.3, 102.4, 12.0)).snapshot()
    # Some leaves with bounds, one from below alone, and some of what was seen is not mapped yet.
    low, high = found.z - 0.3, found.z + 0.4
    low[::3] = high[::3] = high[1] = np.nan
    known = found.known.copy()
    known[:2, :5] = False
    assert (known != found.known).any()
    return dataclasses.replace(found, low=low, high=high, known=known)


def decoded(records, cells: CellMap) -> CellMap:
    where = cells.domain.xmin, cells.domain.ymin
    seen = maps.decode_observed(maps.encode_observed(cells.observed, cells.known))
    return maps.decode_cells(records, seen[0], *where, cells.stamp_ns, known=seen[1])


def test_what_matters_comes_back_exactly(cells):
    back = decoded(maps.encode_cells(cells), cells)
    assert back.domain == cells.domain
    assert back.stamp_ns == cells.stamp_ns
    for name in EXACT:
        np.testing.assert_array_equal(getattr(back, name), getattr(cells, name), name)
        assert getattr(back, name).dtype == getattr(cells, name).dtype
    for name in SINGLE:
        np.testing.assert_allclose(getattr(back, name), getattr(cells, name), rtol=6e-8, atol=1e-38)


def test_a_round_trip_is_what_a_subscriber_decodes(cells):
    given = maps.encode_cells(cells), cells.observed, cells.domain.xmin, cells.domain.ymin
    received = maps.decode_cells(*given, cells.stamp_ns, known=cells.known)
    assert_same(maps.round_trip(cells), received)


def on_one_place(records):
    """The areas sum up, but one leaf covers another's ground."""
    first, second = np.flatnonzero(records["level"] == records["level"][0])[:2]
    for key in ("ix", "iy"):
        records[key][second] = records[key][first]
    return records


def beyond(name):
    def moved(records):
        records[name][3] = 200
        return records

    return moved


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda r: r[:0], "no_cells"),
        (lambda r: r[1:], "tiling"),
        (lambda r: np.concatenate([r, r[:1]]), "tiling"),
        (on_one_place, "tiling"),
        *((beyond(name), "tiling") for name in ("level", "ix", "iy")),
    ],
)
def test_leaves_that_do_not_tile_the_domain_are_refused(cells, damage, reason):
    with pytest.raises(MessageError) as caught:
        decoded(damage(maps.encode_cells(cells)), cells)
    assert caught.value.reason == reason
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("shape", [(63, 63), (64, 32), (32, 64), (0, 0), (48, 48), (16, 16)])
def test_observed_is_a_square_power_of_two_as_fine_as_the_finest_leaves(cells, shape):
    with pytest.raises(MessageError) as caught:
        maps.decode_cells(maps.encode_cells(cells), np.zeros(shape, dtype=bool), 0.0, 0.0, 1)
    assert caught.value.reason == ("tiling" if shape == (16, 16) else "observed_shape")


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("size", np.nan),
        ("size", 0.0),
        ("size", -1.0),
        ("size", np.inf),
        ("elevation", np.nan),
        ("elevation", np.inf),
        ("normal_x", np.nan),
        ("normal_z", 0.0),
        ("normal_z", -1.0),
        ("min_level", 200),
        ("offset_z", np.inf),
        ("offset_variance", -1.0),
    ],
)
def test_impossible_values_are_refused(cells, name, value):
    """A measured leaf needs a finite, upward plane, or unsafe ground would pass for safe."""
    records = maps.encode_cells(cells)
    records[name] = value
    with pytest.raises(MessageError) as caught:
        decoded(records, cells)
    assert "\n" not in str(caught.value)


def test_site_table_and_grids(cells):
    config = configured(domain={"xmin": -7.3, "ymin": 102.4}, vehicle={"diameter": 2.0})
    assessment = LandingSiteSelector(config).assess(cells)
    assert len(assessment.sites.score) > 0
    table = maps.encode_sites(assessment)
    np.testing.assert_allclose(table["x"], assessment.sites.position[:, 0], rtol=1e-6)
    for name in ("score", "roughness", "hazard_distance", "subscale_height", "id", "probability"):
        np.testing.assert_allclose(table[name], getattr(assessment.sites, name), rtol=1e-6)
    np.testing.assert_allclose(table["slope"], np.radians(assessment.sites.slope_deg), rtol=1e-6)
    score = maps.encode_score(assessment)
    allowed = np.isfinite(assessment.score)
    assert (score[~allowed] == 100).all()
    assert score[allowed].min() == 0
    assert score[allowed].max() == 99
    best = np.unravel_index(np.nanargmin(assessment.score), score.shape)
    assert score[best] == 0
    hazard = maps.encode_hazards(assessment)
    assert set(np.unique(hazard)) <= {-1, 0, 100}
    assert (hazard[(assessment.hazard & 0x0F) > 0] == 100).all()
    assert (hazard[assessment.hazard == 0x80] == -1).all()
    assert (hazard[assessment.hazard == 0] == 0).all()
    observed = maps.encode_observed(cells.observed, cells.known)
    np.testing.assert_array_equal(observed == 100, cells.known)
    np.testing.assert_array_equal(observed == 50, cells.observed & ~cells.known)
    np.testing.assert_array_equal(observed == -1, ~cells.observed)


def test_cells_of_the_landing_grids_lie_about_the_grid_points(cells):
    """An occupancy grid's origin is the corner of its first cell, a grid map's its middle."""
    config = configured(domain={"xmin": -7.3, "ymin": 102.4}, vehicle={"diameter": 2.0})
    found, maker = LandingSiteSelector(config).assess(cells), MessageMaker(Types(), list, "map")
    grids = [m.info for topic, m in maker.of_ground(found) if TOPIC_TYPES[topic] == GRID_TYPE]
    assert len(grids) == 3
    for info in grids:
        corner, step = info.origin.position, info.resolution
        x = corner.x + step * (np.arange(info.width) + 0.5)
        y = corner.y + step * (np.arange(info.height) + 0.5)
        np.testing.assert_allclose(x, found.x)
        np.testing.assert_allclose(y, found.y)
    info = maker.grid_map(found).info
    for axis in "xy":
        ends, length = getattr(found, axis)[[0, -1]], getattr(info, f"length_{axis}")
        assert getattr(info.pose.position, axis) == pytest.approx(ends.mean())
        assert length == pytest.approx(np.ptp(ends) + info.resolution)


@pytest.mark.parametrize(
    ("low", "high"), [(2.0, 1.0), (np.inf, np.nan), (np.nan, -np.inf), (-1e8, 1.0)]
)
def test_bounds_that_none_can_be_are_refused(cells, low, high):
    records = maps.encode_cells(cells)
    records["low"][4], records["high"][4] = low, high
    with pytest.raises(MessageError, match="bounds") as caught:
        decoded(records, cells)
    assert caught.value.reason == "values"


def test_unseen_ground_may_be_hazardous_too(cells):
    """Ground with both bits is a hazard; ground with bits of unknown ground only is unknown."""
    config = configured(domain={"xmin": -7.3, "ymin": 102.4}, vehicle={"diameter": 2.0})
    assessment = LandingSiteSelector(config).assess(cells)
    bits = np.array([[0, 1, 128, 129, 192, 193, 32, 40]], dtype=np.uint8)
    values = maps.encode_hazards(dataclasses.replace(assessment, hazard=bits))
    assert values.tolist() == [[0, 100, -1, 100, -1, 100, -1, 100]]


def test_a_map_of_another_scale_is_refused_before_anything_is_made_of_it(cells):
    """Well-formed, but 12 km wide: landing sites on it would take 24,000 grid points a side."""
    records = maps.encode_cells(cells)
    records["size"] *= 12_000.0 / cells.domain.size
    tracemalloc.start()
    with pytest.raises(maps.MessageError, match="grid points a side") as caught:
        maps.decode_cells(records, cells.observed, 0.0, 0.0, 1, LssConfig())
    assert tracemalloc.get_traced_memory()[1] < 1e7
    tracemalloc.stop()
    assert caught.value.reason == "too_large"
    assert maps.decode_cells(records, cells.observed, 0.0, 0.0, 1).domain.size == 12_000.0
