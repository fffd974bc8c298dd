# SPDX-License-Identifier: Apache-2.0
"""Rocks that the mean over a large leaf hides divide it; curved ground and noise do not."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from core.builders import configured, mapped

NOISE = 0.05
LEAVES_4M = {"xmin": 0.0, "ymin": 0.0, "size": 16.0, "min_level": 2, "max_level": 6}


def bump(x, y, x0, y0, radius, height):
    """A round boulder, level on top of its middle and steep at its edge."""
    inside = np.maximum(1.0 - ((x - x0) ** 2 + (y - y0) ** 2) / radius**2, 0.0)
    return height * np.sqrt(inside)


def test_raised_points_alone_divide():
    """A rock lower than an exception across the border of two leaves; the other signs are off.

    Each leaf's half of it is 0.09 m^2 above four deviations.
    """
    for area in (0.0, 0.04):
        config = configured(
            domain=LEAVES_4M,
            lidar={"range_noise": NOISE},
            mapping={"divide_area": area, "divide_exceptions": 0.0},
            features={"divide_sigma": 0.0},
        )
        ground = functools.partial(bump, x0=8.0, y0=6.0, radius=0.45, height=0.29)
        cells = mapped(config, ground, density=900.0, scans=2).snapshot()
        under = (np.abs(cells.x - 8.0) < 4.0) & (np.abs(cells.y - 6.0) < 2.0)
        np.testing.assert_array_equal(cells.size < 4.0, under & (area > 0.0))


@pytest.mark.parametrize(
    "ground",
    [
        lambda x, y: 0.0 * x,
        lambda x, y: 0.2 * x - 0.1 * y,
        lambda x, y: 0.05 * ((x % 4.0 - 2.0) ** 2 + (y % 4.0 - 2.0) ** 2),
    ],
    ids=["level", "slope", "bowls"],
)
def test_noise_and_curvature_are_no_rocks(ground):
    """Bowls raise a leaf's corners by 0.27 m; division by lack of fit is kept out of it."""
    config = configured(
        domain=LEAVES_4M,
        lidar={"range_noise": NOISE},
        mapping={"divide_exceptions": 0.0, "division_factor": 20.0},
    )
    assert mapped(config, ground, density=900.0, scans=3).leaves.count == 16
