# SPDX-License-Identifier: Apache-2.0
"""Rocks that the mean over a large leaf hides divide it; curved ground and noise do not."""

import functools

import numpy as np
import pytest
from core.builders import by, configured, mapped
from core.kernels import division
from core.scenes import flat, scattered
from scipy.stats import norm

from quadtree_lss.onboard.core.geometry import morton

NOISE = 0.05
LEAVES_4M = {"xmin": 0.0, "ymin": 0.0, "size": 16.0, "min_level": 2, "max_level": 6}
NEVER = np.inf


def bump(x, y, x0, y0, radius, height):
    """A round boulder, level on top of its middle and steep at its edge."""
    inside = np.maximum(1.0 - ((x - x0) ** 2 + (y - y0) ** 2) / radius**2, 0.0)
    return height * np.sqrt(inside)


def test_a_rock_that_noise_hides_in_every_scan_divides():
    """0.25 m under noise of 0.1 m, seen by one return a finest cell and scan; without it, none.

    No return stands out: an exception, three deviations, is farther off than the rock is high.
    """
    config = configured(domain={**LEAVES_4M, "max_level": 5}, noise=0.1)
    ground = functools.partial(bump, x0=5.25, y0=6.75, radius=0.6, height=0.25)
    for surface, share in ((ground, np.inf), (ground, 1.0 / 3.0), (flat(), 1.0 / 3.0)):
        with by(MOUND=share, ROCK_EXCEPTIONS=NEVER, ROCK_SIGMA=0.0):
            cells = mapped(config, surface, density=4.0, scans=30).snapshot()
        finest = cells.size < 1.0
        assert finest.any() == (surface is ground and share < NEVER)
        assert (np.hypot(cells.x - 5.25, cells.y - 6.75)[finest] < 1.5).all()


def test_every_return_lies_in_one_pile():
    """However often the leaf above it divides on the way; under a finest leaf perhaps in none."""
    ground = functools.partial(bump, x0=8.0, y0=6.0, radius=0.45, height=0.29)
    config = configured(domain=LEAVES_4M, noise=NOISE)
    table = mapped(config, ground, scans=4, noise=0.0, seed=1).leaves
    rng, fell = np.random.default_rng(1), np.zeros(4**6)
    for _ in range(4):  # where `mapped` put them
        x, y = scattered(rng, 0.0, 0.0, 16.0, 60 * 256)
        ix, iy = (np.floor(4.0 * along).astype(int) for along in (x, y))
        np.add.at(fell, morton.SPREAD[ix] | morton.SPREAD[iy] << 1, 1.0)
    piled, level = table.piled[:, 1], table.rows.level[table.leaf_of]
    assert (piled <= fell).all() and len(set(level)) > 2
    np.testing.assert_array_equal(piled[level == 2], fell[level == 2])


def test_pits_divide_by_their_exceptions():
    """A pit as narrow as a rock has no raised points, and too few points to move a mean."""
    config = configured(domain=LEAVES_4M, noise=NOISE)
    ground = functools.partial(bump, x0=6.0, y0=6.0, radius=0.3, height=-0.6)
    for exceptions in (NEVER, 1.5):
        with by(ROCK_EXCEPTIONS=exceptions):
            cells = mapped(config, ground, density=400.0, scans=2).snapshot()
        under = (np.abs(cells.x - 6.0) < 2.0) & (np.abs(cells.y - 6.0) < 2.0)
        np.testing.assert_array_equal(cells.size < 4.0, under & (exceptions < NEVER))


@pytest.mark.parametrize(
    "ground",
    [
        lambda x, y: 0.0 * x,
        lambda x, y: 0.2 * x - 0.1 * y,
        lambda x, y: 0.014 * ((x % 4.0 - 2.0) ** 2 + (y % 4.0 - 2.0) ** 2),
    ],
    ids=["level", "slope", "bowls"],
)
def test_noise_and_curvature_are_no_rocks(ground):
    """Bowls raise a leaf's corners by 0.07 m; division by lack of fit is kept out of it."""
    config = configured(domain=LEAVES_4M, noise=NOISE, mapping={"division_factor": 20.0})
    with by(ROCK_EXCEPTIONS=NEVER):
        assert mapped(config, ground, density=900.0, scans=3).leaves.count == 16


def test_of_depths_of_stereo_one_of_four_stands_for_all():
    """Exceptions of many residuals, in any order: the same share, asked of a quarter of them."""
    rng = np.random.default_rng(6)
    residual = rng.normal(0.0, 0.05, 4001)
    every, fourth = (division.exceptions(residual, 4001, k, 0.08, 0.04) for k in (1, 4))
    by_hand = norm.sf((0.08 - np.abs(residual)) / 0.04) + norm.sf((0.08 + np.abs(residual)) / 0.04)
    np.testing.assert_allclose(every, by_hand.sum(), rtol=1e-9)
    np.testing.assert_allclose(fourth, 4001 / 1001 * by_hand[::4].sum(), rtol=1e-9)
    assert fourth == pytest.approx(every, rel=0.1) and fourth != every
