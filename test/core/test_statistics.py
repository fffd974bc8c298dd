# SPDX-License-Identifier: Apache-2.0
"""Roughness density (Eq. 55), exceptions (Eq. 48) and the check of the range noise."""

import numpy as np
import pytest
from core.builders import by, configured, look, mapped
from core.scenes import (
    ABOVE,
    EXACT,
    flat,
    lattice,
    make_pose,
    pose_covariance,
    scan,
    scattered,
    slope,
)

from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.tree.cell_map import CellMap


def fixed(level: int, noise: float):
    return configured(levels=(level, level), noise=noise)


def seen_on_lattice(config, surface, per_side: int, covariance=EXACT) -> CellMap:
    """Noise-free look at points on a grid."""
    mapper, pose = Mapper(config), make_pose((8.0, 8.0, 4000.0), covariance)
    look(mapper, surface, *lattice(0.0, 0.0, 16.0, per_side), pose=pose)
    return mapper.snapshot()


@pytest.mark.parametrize("level", [1, 3])
@pytest.mark.parametrize("surface", [flat(), slope(0.15, 0.1)], ids=["flat", "slope"])
def test_noise_on_a_plane_is_no_roughness(level, surface):
    """The floor is taken off: what is left is the error of a mean, 0.6 sigma / sqrt(N)."""
    config = fixed(level, 0.05)
    cells = mapped(config, surface, density=60.0, scans=3).snapshot()
    bound = cells.size**2 * 5.0 * 0.6 * 0.05 / np.sqrt(cells.count)
    assert (cells.roughness <= bound).all()
    # Without the floor's removal it would be the area times 0.8 sigma.
    assert cells.roughness.mean() < 0.1 * cells.size[0] ** 2 * 0.8 * 0.05


@pytest.mark.parametrize("level", [1, 2, 3])
@pytest.mark.parametrize("per_side", [160, 320])
def test_roughness_of_a_rock_is_independent_of_cell_size_and_density(level, per_side):
    """A rock of volume V and footprint a in the middle of a cell of area A lifts the plane by
    V / A, so that Eq. 55 gives V (1 - a / A) for the rock and as much for the ground around it."""
    half, height = 0.4, 0.25
    size = 16.0 / 2**level
    middle = 0.5 * size

    def ground(x, y):
        return height * ((np.abs(x - middle) < half) & (np.abs(y - middle) < half))

    noise = 3e-4  # not in the points, but its floor is taken off
    cells = seen_on_lattice(fixed(level, noise), ground, per_side)
    volume, footprint = height * (2.0 * half) ** 2, (2.0 * half) ** 2
    expected = 2.0 * volume * (1.0 - footprint / size**2) - size**2 * np.sqrt(2.0 / np.pi) * noise
    at = np.argmin(np.hypot(cells.x - middle, cells.y - middle))
    assert cells.roughness[at] == pytest.approx(expected, rel=0.02)
    assert np.delete(cells.roughness, at).max() < 1e-3 * expected


@pytest.mark.parametrize(
    ("height", "tolerance", "share"),
    [(1.0, 0.3, 1.0), (0.3 / (1.0 - 1.0 / 64.0), 0.3, 0.5), (0.2, 0.3, 0.0), (0.2, 0.1, 1.0)],
)
def test_exceptions_are_the_share_of_points_beyond_the_tolerance(height, tolerance, share):
    """A block of half a metre covers 1/64 of a 4 m cell, and lifts the plane by 1/64 of its height.

    xi is the mass of the residual's distribution outside: a half when it is centred there.
    """

    def ground(x, y):
        return height * ((np.abs(x - 2.0) < 0.25) & (np.abs(y - 2.0) < 0.25))

    with by(tolerance=tolerance):
        cells = seen_on_lattice(fixed(2, 0.01), ground, 256)
    at = np.argmin(np.hypot(cells.x - 2.0, cells.y - 2.0))
    assert cells.exception_fraction[at] == pytest.approx(share / 64.0, rel=0.03, abs=1e-6)
    assert np.delete(cells.exception_fraction, at).max() < 1e-6


def test_pose_uncertainty_makes_no_exception_of_flat_ground():
    """Erratum of Eq. 48: a metre of common error says nothing of the ground within the cell."""
    cells = seen_on_lattice(fixed(2, 0.02), flat(), 64, pose_covariance(1.0, 1e-3))
    assert cells.exception_fraction.max() < 1e-6


def test_wild_points_count_at_most_the_clip():
    """One point a kilometre off adds the clip to the sum, not a kilometre.

    About the scan's own mean the others lie as far off on one side, all together, as the wild one
    on the other: clipped, it leaves their half of the sum.
    """
    pose = make_pose((8.0, 8.0, 4000.0))
    x, y = lattice(0.0, 0.0, 16.0, 128)
    points = scan(flat(), x, y, pose, 0.0)
    wild = points.copy()
    wild[0, 2] -= 1000.0
    roughness = {}
    for clip in (0.5, 1000.0):
        with by(clip=clip):
            mapper = Mapper(fixed(1, 1e-3))
        for cloud in (points, wild):
            mapper.update(cloud, pose)
        roughness[clip] = mapper.snapshot().roughness.max()
    assert roughness[1000.0] > 15.0
    own = 64.0 * 0.5 / (2 * 4096)
    assert roughness[0.5] == pytest.approx(0.5 * roughness[1000.0] + own, rel=0.02)


@pytest.mark.parametrize("per_cell", [12, 190])
def test_the_noise_ratio_is_observed_over_configured_and_follows_by_a_tenth_a_scan(per_cell):
    """Of few points a cell, too: three of their degrees of freedom went into the plane."""
    rng, mapper = np.random.default_rng(1), Mapper(fixed(3, 0.05))
    assert np.isnan(mapper.update(np.zeros((0, 3)), make_pose()).noise_ratio)
    for factor, expected in ((1.0, 1.0), (2.0, 1.1), (2.0, 1.19)):
        x, y = scattered(rng, 0.0, 0.0, 16.0, 64 * per_cell)
        found = look(mapper, flat(), x, y, rng, 0.05 * factor).noise_ratio
        assert found == pytest.approx(expected, abs=0.03 + 0.4 / per_cell)


def test_noise_ratio_is_that_of_level_ground():
    """Most points are on a bank of 45 degrees that is rough."""
    rng, mapper = np.random.default_rng(17), Mapper(configured(noise=0.05))
    x, y = scattered(rng, 0.0, 0.0, 16.0, 30_000)
    rough = rng.normal(0.0, 0.5, len(x))
    bank = lambda x, y: np.where(x > 5.0, x - 5.0 + rough[: len(x)], 0.0)  # noqa: E731
    assert look(mapper, bank, x, y, rng, 0.05).noise_ratio == pytest.approx(1.0, abs=0.1)


def test_the_noise_ratio_moves_by_a_tenth_of_what_each_scan_says():
    """The first scan of a new mapper gives what a scan determines by itself."""
    config = fixed(3, 0.05)
    rng, mapper, before = np.random.default_rng(2), Mapper(config), None
    for factor in (1.0, 3.0, 3.0, 0.5):
        x, y = scattered(rng, 0.0, 0.0, 16.0, 64 * 100)
        points = scan(flat(), x, y, make_pose(ABOVE), 0.05 * factor, rng)
        alone, ratio = (of.update(points, make_pose(ABOVE)).noise_ratio
                        for of in (Mapper(config), mapper))  # fmt: skip
        if before is not None:
            assert (ratio - before) / (alone - before) == pytest.approx(0.1, rel=1e-6)
        before = ratio
