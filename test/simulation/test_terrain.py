# SPDX-License-Identifier: Apache-2.0
"""Terrain: interpolation, files; rocks: how many, and stone by stone against their formula."""

import numpy as np
import pytest

from quadtree_lss.lab.simulation.hazard_field import (
    HazardField,
    hazard_field,
    sample_rock_diameters,
)
from quadtree_lss.lab.simulation.terrain import Terrain

SMALL = HazardField(size=30.0)


def test_bilinear_surface_is_exact_for_bilinear_functions():
    x, y = np.linspace(-3.0, 5.0, 17), np.linspace(2.0, 4.0, 9)

    def function(u, v):
        return 1.0 + 0.3 * u - 0.2 * v + 0.05 * u * v

    terrain = Terrain(x, y, function(x[None, :], y[:, None]))
    generator = np.random.default_rng(1)
    u, v = generator.uniform(-3.0, 5.0, 500), generator.uniform(2.0, 4.0, 500)
    np.testing.assert_allclose(terrain.elevation_at(u, v), function(u, v), atol=1e-12)
    np.testing.assert_allclose(terrain.elevation_at(x[None, :], y[:, None]), terrain.elevation)
    assert np.isnan(terrain.elevation_at([-3.01, 0.0], [3.0, 4.01])).all()


def test_rocks_cover_the_ground_as_golombek_and_rapp_say():
    """Rocks larger than D cover k exp(-q D), q = 1.79 + 0.152 / k."""
    area, k, q = 4e5, 0.05, 1.79 + 3.04
    diameters = sample_rock_diameters(np.random.default_rng(2), area, k, 0.1, 1.0)
    assert 0.1 <= diameters.min() and diameters.max() <= 1.0
    for threshold in (0.1, 0.2, 0.4, 0.6):
        larger = diameters[diameters > threshold]
        cover = np.pi / 4.0 * np.sum(larger**2) / area
        expected = k * (np.exp(-q * threshold) - np.exp(-q))
        spread = np.pi / 4.0 * np.sqrt(np.sum(larger**4)) / area
        assert abs(cover - expected) < 4.0 * spread


def test_field_has_what_was_asked_for():
    terrain = hazard_field(np.random.default_rng(3), SMALL)
    assert terrain.elevation.shape == (301, 301) and terrain.post == pytest.approx((0.1, 0.1))
    assert np.ptp(terrain.elevation) < 4.0
    bare = HazardField(size=30.0, rock_abundance=1e-6, piles=0.0, craters=0.0, texture=0.0)
    smooth = hazard_field(np.random.default_rng(3), bare)
    slopes = np.degrees(np.arctan(np.hypot(*np.gradient(smooth.elevation, 0.1))))
    assert slopes.max() < 8.0
