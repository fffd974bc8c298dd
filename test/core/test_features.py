# SPDX-License-Identifier: Apache-2.0
"""Subscale features: hemispheres in a flat 2 m cell are found, measured, and not imagined."""

import numpy as np
import pytest
from core.builders import by, configured, look, mapped
from core.kernels import features
from core.scenes import lattice, make_pose, slope

from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.cell_map import CellMap, peak

CELLS_2M = {"min_level": 3, "max_level": 3}
A, K, MU_X, MU_Y, SIGMA = range(5)
#: A bell fitted to a boulder (hemisphere) peaks a quarter above it: published heights are lower
#: by that, and sigma wider by its root, which keeps the volume.
SHAPE = 1.25


def hemispheres(seed: int, smallest: float = 0.15, largest: float = 0.4):
    """One hemisphere in each cell of 2 m, wholly inside: radius, centre (64,), row-major."""
    rng = np.random.default_rng(seed)
    radius = rng.uniform(smallest, largest, 64)
    reach = 1.0 - radius - 0.05
    x = 2.0 * (np.arange(64) % 8) + 1.0 + reach * rng.uniform(-1.0, 1.0, 64)
    y = 2.0 * (np.arange(64) // 8) + 1.0 + reach * rng.uniform(-1.0, 1.0, 64)
    return radius, x, y


def rocky(radius, x0, y0):
    """Ground with those hemispheres."""

    def ground(x, y):
        cell = np.clip(y // 2.0, 0, 7).astype(int) * 8 + np.clip(x // 2.0, 0, 7).astype(int)
        square = radius[cell] ** 2 - (x - x0[cell]) ** 2 - (y - y0[cell]) ** 2
        return np.sqrt(np.maximum(square, 0.0))

    return ground


def by_place(cells: CellMap) -> np.ndarray:
    """(64, 5) features, row-major over the 2 m cells."""
    order = np.lexsort((cells.ix, cells.iy))
    return cells.feature[order]


def test_hemispheres_are_found_with_their_height_and_place():
    """100 points/m^2 and scan, 3 scans, 4 cm noise: nine of ten are found, which means with
    their height within 35 % and their centre within 0.1 m."""
    config = configured(domain=CELLS_2M, noise=0.04)
    found, high, near = [], [], []
    for seed in range(5):
        radius, x0, y0 = hemispheres(seed)
        cells = mapped(config, rocky(radius, x0, y0), density=100.0, scans=3, seed=seed).snapshot()
        state = by_place(cells)
        centre_x = 2.0 * (np.arange(64) % 8) + 1.0 + state[:, MU_X]
        centre_y = 2.0 * (np.arange(64) // 8) + 1.0 + state[:, MU_Y]
        found.append(np.isfinite(state[:, K]))
        high.append(np.abs(peak(state) / radius - 1.0) <= 0.35)
        near.append(np.hypot(centre_x - x0, centre_y - y0) <= 0.1)
    found, high, near = np.concatenate(found), np.concatenate(high), np.concatenate(near)
    assert np.mean(found) >= 0.9
    assert np.mean(found & near) >= 0.9
    assert np.mean(found & near & high) >= 0.9


@pytest.mark.parametrize(
    ("gradient", "density", "noise"),
    [((0.0, 0.0), 100.0, 0.04), ((0.15, -0.1), 100.0, 0.04), ((0.0, 0.0), 30.0, 0.04)]
    + [((0.0, 0.0), 12.0, 0.1)],
)
def test_plain_ground_has_hardly_any_feature(gradient, density, noise):
    """One in 1,280 cells; height is above the cell's plane, so slopes are none."""
    config, ground = configured(domain=CELLS_2M, noise=noise), slope(*gradient)
    maps = (mapped(config, ground, density=density, seed=seed).snapshot() for seed in range(20))
    assert sum(np.isfinite(cells.feature[:, K]).sum() for cells in maps) <= 1


def bell(height: float, sigma: float, x0: float, y0: float):
    return lambda x, y: height * np.exp(-0.5 * ((x - x0) ** 2 + (y - y0) ** 2) / sigma**2)


def seen_on_4m(ground, gradient: float) -> np.ndarray:
    """Feature (5,) of a single cell of 4 m after three dense scans; it may slope along x."""
    config = configured(domain={"size": 4.0, "min_level": 0, "max_level": 0}, noise=0.01)
    mapper, rng = Mapper(config), np.random.default_rng(1)
    x, y = lattice(0.0, 0.0, 4.0, 80)
    pose = make_pose((2.0, 2.0, 500.0))
    for _ in range(3):
        look(mapper, lambda x, y: ground(x, y) + gradient * x, x, y, rng, 0.01, pose)
    return mapper.snapshot().feature[0]


@pytest.mark.parametrize(
    ("height", "sigma", "gradient"), [(0.4, 0.15, 0.0), (0.3, 0.2, 0.0), (0.6, 0.12, 0.5)]
)
def test_k_squared_is_the_volume(height, sigma, gradient):
    """Erratum of Eq. 49: a bell of height p has volume 2 pi sigma^2 p; p is vertical on slopes."""
    state = seen_on_4m(bell(height, sigma, 2.3, 1.8), gradient)
    volume = 2.0 * np.pi * sigma**2 * height
    # The cell's plane leans a little towards the bump, which takes a few per cent of it.
    assert state[K] ** 2 == pytest.approx(volume, rel=0.08)
    assert abs(state[SIGMA]) == pytest.approx(np.sqrt(SHAPE) * sigma, rel=0.05)
    assert peak(state) == pytest.approx(height / SHAPE, rel=0.05)
    np.testing.assert_allclose(state[[MU_X, MU_Y]], [0.3, -0.2], atol=0.02)


#: Each limit, and what of a published state (M, 5) it is about: at least, but for the last.
LIMITS = {
    "FEATURE_HEIGHT": (0.3, peak),
    "FEATURE_VOLUME": (0.05, lambda state: state[:, K] ** 2),
    "FEATURE_WIDTH": (-0.08, lambda state: -state[:, SIGMA] / (np.sqrt(SHAPE) * 2.0)),
}


@pytest.mark.parametrize("limit", LIMITS)
def test_limits_are_obeyed(limit):
    """Of the features found without a limit some go against it, with it none."""
    least, of = LIMITS[limit]
    ground = rocky(*hemispheres(4))

    def found(**limits: float) -> np.ndarray:
        with by(**limits):
            config = configured(domain=CELLS_2M, noise=0.04)
            state = by_place(mapped(config, ground, density=100.0).snapshot())
        return of(state[np.isfinite(state[:, K])])

    without, limited = found(), found(**{limit: abs(least)})
    assert (without < least).any()
    assert len(limited) > 5
    assert (limited >= least - 1e-12).all()


def test_too_few_points_make_no_feature():
    ground = rocky(*hemispheres(3, 0.35, 0.4))
    rng = np.random.default_rng(2)
    for per_side, some in ((3, False), (5, True)):  # 9 and 25 points in each cell
        mapper = Mapper(configured(domain=CELLS_2M, noise=0.01))
        for _ in range(3):
            look(mapper, ground, *lattice(0.0, 0.0, 16.0, 8 * per_side), rng, 0.01)
        assert np.isfinite(mapper.snapshot().feature[:, K]).any() == some


def test_a_bell_is_that_of_the_exponential_function():
    square = np.linspace(0.0, 20.0, 1001)
    bell = np.array([features.bell(s) for s in square])
    np.testing.assert_allclose(bell, np.exp(-0.5 * square), rtol=1e-8)
    assert [features.bell(s) < 1e-15 for s in (80.0, 1e3, 1e6, 1e300)] == [True] * 4
