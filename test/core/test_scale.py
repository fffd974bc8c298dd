# SPDX-License-Identifier: Apache-2.0
"""No absolute length decides: world, vehicle, noise and cells scaled alike give the same answer."""

import dataclasses

import numpy as np
import pytest
from core.builders import configured
from core.scenes import lattice, make_pose, pose_covariance, scan, scattered

from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.cell_map import CellMap

SCALES = (0.1, 0.3, 3.0)


def at_scale(scale: float, assessment: str) -> Config:
    """A lander of 2 m that leans too far on less than its clearance; all lengths scaled alike."""
    return configured(
        domain={"size": 16.0 * scale},
        vehicle={
            "diameter": 2.0 * scale,
            "clearance": 0.2 * scale,
            "max_slope_deg": 7.0,
            "pad_radius": 0.1 * scale,
        },
        lidar={"range_noise": 0.02 * scale, "min_range": 0.1 * scale},
        lss={
            "assessment": assessment,
            "dispersion": 0.4 * scale,
            "margin": 0.1 * scale,
            "max_risk": 0.04,
        },
    )


def ground(x, y):
    """Rocks of many heights about the clearance, a step, a roll."""
    high = 0.02 * np.cos(1.7 * x) * np.cos(2.3 * y) + 0.03 * x
    for k in range(12):
        east, north, size = 16.0 * np.modf(k * 0.618)[0], 1.4 * k, 0.1 + 0.02 * k
        away = (x - east) ** 2 + (y - north) ** 2
        high = high + np.sqrt(np.maximum(size**2 - away, 0.0))
    return high + 0.4 * (x > 13.0)


def seen(scale: float, config: Config) -> CellMap:
    """The map of three scans of it."""
    mapper = Mapper(config)
    rng = np.random.default_rng(5)
    claimed = pose_covariance(0.01 * scale, 1e-4)
    for k in range(3):
        pose = make_pose((8.0 * scale, 8.0 * scale, 500.0 * scale), claimed, stamp_ns=1 + k)
        x, y = (scale * of for of in scattered(rng, 0.0, 0.0, 16.0, 20_000))
        surface = scale * ground(x / scale, y / scale)
        mapper.update(scan(lambda *_: surface, x, y, pose, 0.02 * scale, rng), pose)  # noqa: B023
    return mapper.snapshot()


def enlarged(cells: CellMap, scale: float) -> CellMap:
    """The same map with all lengths scaled; a plane's covariance is of (rad, rad, m)."""
    by = np.outer([1.0, 1.0, scale], [1.0, 1.0, scale])
    domain, given = cells.domain, cells
    lengths = {name: scale * getattr(cells, name) for name in ("z", "low", "high")}
    return dataclasses.replace(
        given,
        **lengths,
        domain=dataclasses.replace(
            domain, xmin=scale * domain.xmin, ymin=scale * domain.ymin, size=scale * domain.size
        ),
        covariance_range=by * cells.covariance_range,
        covariance_pose=by * cells.covariance_pose,
        roughness=scale**3 * cells.roughness,
        feature=cells.feature * np.array([1.0, scale**1.5, scale, scale, scale]),
    )


@pytest.fixture(scope="module")
def cells() -> CellMap:
    return seen(1.0, at_scale(1.0, "touchdown"))


def assert_same(found, other, scale: float) -> None:
    np.testing.assert_array_equal(found.hazard, other.hazard)
    np.testing.assert_array_equal(found.safe, other.safe)
    np.testing.assert_allclose(found.score, other.score, atol=1e-6)
    for name in ("risk", "probability"):
        np.testing.assert_allclose(getattr(found, name), getattr(other, name), rtol=1e-3, atol=1e-6)
    assert len(found.sites) == len(other.sites) > 1
    place = found.sites.position
    np.testing.assert_allclose(place, other.sites.position / scale, rtol=1e-6, atol=1e-6)
    for name in ("hazard_distance", "roughness", "subscale_height"):
        mine, its = getattr(found.sites, name), getattr(other.sites, name)
        np.testing.assert_allclose(mine, its / scale, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("assessment", ["paper", "touchdown", "probability"])
@pytest.mark.parametrize("scale", SCALES)
def test_landing_answers_the_same_at_every_scale(cells, scale, assessment):
    found = LandingSiteSelector(at_scale(1.0, assessment)).assess(cells)
    selector = LandingSiteSelector(at_scale(scale, assessment))
    assert 0.03 < found.safe.mean() < 0.8
    assert_same(found, selector.assess(enlarged(cells, scale)), scale)


@pytest.mark.parametrize("scale", SCALES)
def test_the_map_is_the_same_at_every_scale(cells, scale):
    config = at_scale(scale, "touchdown")
    mine, its = cells, seen(scale, config)
    np.testing.assert_array_equal(mine.level, its.level)
    np.testing.assert_array_equal(mine.measured, its.measured)
    np.testing.assert_allclose(mine.z, its.z / scale, atol=1e-6)
    np.testing.assert_allclose(mine.normal, its.normal, atol=1e-6)


@pytest.mark.parametrize("scale", [0.125, 4.0])
def test_a_feature_that_noise_hardly_shows_is_the_same_at_every_scale(scale):
    """Of few returns, so that what is known before them counts: by powers of two, to the bit."""

    def feature(scale: float) -> np.ndarray:
        lander = {"diameter": 3.7 * scale, "clearance": 0.3 * scale, "pad_radius": 0.15 * scale}
        config = configured(
            domain={"size": 4.0 * scale, "min_level": 0, "max_level": 0},
            lidar={"range_noise": 0.1 * scale, "min_range": 0.1 * scale},
            vehicle=lander,
        )
        mapper, (x, y) = Mapper(config), lattice(0.0, 0.0, 4.0, 9)
        z = 0.9 * np.exp(-2.0 * ((x - 2.3) ** 2 + (y - 1.8) ** 2))
        pose = make_pose((2.0 * scale, 2.0 * scale, 500.0 * scale))
        points = scan(lambda *_: scale * z, scale * x, scale * y, pose, 0.0)
        mapper.update(points, pose)
        return mapper.snapshot().feature[0] / (scale, scale**1.5, scale, scale, scale)

    np.testing.assert_allclose(feature(scale), feature(1.0), rtol=1e-9)
