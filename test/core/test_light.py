# SPDX-License-Identifier: Apache-2.0
"""Shadow against rays marched over a surface and by hand; what light and reach are in choosing."""

import dataclasses

import numpy as np
import pytest
from core.builders import mapped
from core.test_sites import RADIUS, small

from quadtree_lss.desk.bags.message_types import typestore
from quadtree_lss.desk.replay.results import grid_of
from quadtree_lss.onboard.config.sections import LightConfig
from quadtree_lss.onboard.config.settings import ConfigError, config_from_values
from quadtree_lss.onboard.core.landing.raster import shadow
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.landing.target import NEARER
from quadtree_lss.onboard.messages.outputs import MessageMaker


def hills(x, y):
    return 1.5 * np.sin(0.7 * x + 0.2 * y) + np.cos(0.9 * y - 0.3 * x) + 0.2 * x


def marched(x, y, azimuth, elevation, low, high):
    """By how much hills stand over the rays from (x, y), K places, in a square; steps of 4 cm."""
    along = np.arange(0.04, 1.5 * (high - low), 0.04)
    px = x[:, None] + along * np.sin(np.radians(azimuth))
    py = y[:, None] + along * np.cos(np.radians(azimuth))
    ray = hills(x, y)[:, None] + along * np.tan(np.radians(elevation))
    inside = (np.minimum(px, py) >= low) & (np.maximum(px, py) <= high)
    return np.where(inside, hills(px, py) - ray, -np.inf).max(axis=1)


@pytest.mark.parametrize("azimuth", [0.0, 20.0, 77.0, 135.0, 211.0, 300.0, 359.0])
@pytest.mark.parametrize("elevation", [8.0, 25.0])
def test_shadow_is_where_rays_meet_higher_ground(azimuth, elevation):
    """Between middles 0.2 m apart these hills are straight to within 2 cm; at the rim the last part
    of a ray has no middles on both sides."""
    axis = np.arange(0.1, 16.0, 0.2)
    x, y = np.meshgrid(axis, axis)
    dark = shadow(hills(x, y), np.ones(x.shape, dtype=bool), 0.2, azimuth, elevation)
    some = np.s_[1:-1:3, 1:-1:3]
    dark, at = dark[some], (x[some].ravel(), y[some].ravel())
    over, surely = (
        marched(*at, azimuth, elevation, axis[0] + rim, axis[-1] - rim).reshape(dark.shape)
        for rim in (0.0, 0.2)
    )
    assert 0.1 < dark.mean() < 0.9 and (dark == (over > 0.0)).mean() > 0.97
    assert dark[surely > 0.02].all() and not dark[over < -0.02].any()


def test_the_shadow_of_a_wall_is_as_long_as_its_height_over_the_tangent():
    """2 m high: from its last cell on so many cells of 0.25 m, on the side away from the sun."""
    ground, known = np.zeros((40, 60)), np.ones((40, 60), dtype=bool)
    ground[:, 30:32] = 2.0
    for elevation in (20.0, 30.0, 60.0):
        count = int(2.0 / np.tan(np.radians(elevation)) / 0.25)
        east, west = (shadow(ground, known, 0.25, of, elevation) for of in (90.0, 270.0))
        np.testing.assert_array_equal(np.flatnonzero(east.all(axis=0)), np.arange(30 - count, 30))
        np.testing.assert_array_equal(np.flatnonzero(west.all(axis=0)), np.arange(32, 32 + count))
        assert east.any(axis=0).sum() == count
        north = shadow(ground.T, known.T, 0.25, 0.0, elevation)
        np.testing.assert_array_equal(north, east.T)
        np.testing.assert_array_equal(shadow(ground, known, 0.25, 270.0, 180.0 - elevation), east)
    assert not shadow(ground, known, 0.25, 90.0, 90.0).any()
    known[0, 0] = False
    np.testing.assert_array_equal(shadow(ground, known, 0.25, 90.0, 0.0), known)
    known[:, 30:32] = False
    assert not shadow(ground, known, 0.25, 90.0, 20.0).any(), "unknown ground casts none"


@pytest.fixture(scope="module")
def walled():
    """A wall 3 m high in the east."""
    return mapped(small(), lambda x, y: 3.0 + 3.0 * (x > 14.0), density=150.0).snapshot()


def lit(sun, **lss):
    """`small` with the sun there."""
    return dataclasses.replace(small(**lss), light=LightConfig(**sun))


SUN = {"azimuth": 90.0, "elevation": 25.0}


def test_a_wall_throws_its_shadow_away_from_the_sun(walled):
    """3 / tan 25 = 6.4 m."""
    found = LandingSiteSelector(lit(SUN)).assess(walled)
    np.testing.assert_allclose(found.x[found.shadow[16]].min(), 7.6, atol=0.5)


def both(walled, **rules):
    """Without light, and with it; ``target`` is less than a metre out of the light."""
    selectors = (LandingSiteSelector(lit(sun, sites=1, **rules)) for sun in ({}, SUN))
    plain, found = (selector.assess(walled, target=(8.0, 8.0)) for selector in selectors)
    before, after = grid_of(plain), grid_of(found)
    assert plain.shadow is plain.reach is None and set(after) - set(before) == {"shadow"}
    for name in before.keys() - {"score"}:
        np.testing.assert_array_equal(after[name], before[name])
    return plain, found


def test_between_equals_the_lit_place_wins(walled):
    plain, found = both(walled, assessment="probability", ranking="probability", dispersion=0.1)

    def dark(sites):
        x, y = sites.position[0, :2]
        return found.shadow[np.argmin(abs(found.y - y)), np.argmin(abs(found.x - x))]

    assert dark(plain.sites) and not dark(found.sites)
    assert found.sites.position[0, 0] == found.x[found.shadow[16]].min() - 0.5


def test_shadow_counts_as_a_metre_of_way_in_the_score(walled):
    plain, found = both(walled)
    np.testing.assert_allclose(found.score, plain.score + NEARER["score"] * found.shadow)


def test_reach_is_what_guidance_or_the_poses_say(walled):
    selector = LandingSiteSelector(lit(SUN))
    area = [(2.0, 3.0), (9.0, 3.0), (9.0, 12.0), (2.0, 12.0)]
    found = selector.assess(walled, area=area, vehicle=(8.0, 0.5, 5.0, 5.0))
    x, y = np.meshgrid(found.x, found.y)
    beside = np.min([x - 2.0, 9.0 - x, y - 3.0, 12.0 - y], axis=0)
    np.testing.assert_array_equal(found.reach, beside >= RADIUS)
    found = selector.assess(walled, vehicle=(8.05, 0.5, 5.0, 5.0))
    grids = MessageMaker(typestore(ros1=False).types, np.asarray, "map").grid_map(found)
    sent = dict(zip(grids.layers, grids.data, strict=True))
    for name, values in (("shadow", found.shadow), ("reach", found.reach)):
        np.testing.assert_array_equal(sent[name].data, values[::-1, ::-1].ravel())
    # 5.05 m over level ground, and not more steeply than 45 degrees.
    np.testing.assert_array_equal(found.reach, np.hypot(x - 5.0, y - 5.0) <= 5.05)
    assert selector.assess(walled, area=[(0.0, 0.0)]).reach is None


@pytest.mark.parametrize("values", [{"elevation": 91.0}, {"elevation": -1.0}, {"azimuth": 400.0}])
def test_a_sun_that_cannot_be_is_refused(values):
    with pytest.raises(ConfigError, match="outside"):
        config_from_values({f"light.{name}": value for name, value in values.items()})
