# SPDX-License-Identifier: Apache-2.0
"""Rocks on a field against their formula, stone by stone."""

import numpy as np

from quadtree_lss.lab.simulation.hazard_field import strewn
from quadtree_lss.lab.simulation.rocks import lay
from quadtree_lss.lab.simulation.terrain import Terrain

AXIS = np.linspace(-3.0, 3.0, 61)


def ellipsoid(x, y, height, long, short, yaw):
    """Height of a half buried ellipsoid over all posts, (61, 61)."""
    dx, dy = AXIS[None, :] - x, AXIS[:, None] - y
    along = (np.cos(yaw) * dx + np.sin(yaw) * dy) / long
    across = (np.cos(yaw) * dy - np.sin(yaw) * dx) / short
    return height * np.sqrt(np.maximum(1.0 - along**2 - across**2, 0.0))


def laid(stones, *, heaped):
    rocks, rows = np.zeros((61, 61)), []
    for x, y, height, long, short, yaw in stones:
        rows.append([x, y, height, long, short, np.cos(yaw), np.sin(yaw)])
    near = np.array([[s[1] - s[3], s[1] + s[3], s[0] - s[3], s[0] + s[3]] for s in stones])
    lay(rocks, AXIS, np.searchsorted(AXIS, near), np.array(rows), heaped)
    return rocks


STONES = [
    (0.3, -0.2, 0.5, 0.9, 0.6, 0.4),
    (-1.1, 1.0, 0.3, 0.5, 0.45, 2.0),
    (2.9, 0.0, 0.4, 0.6, 0.5, 1.0),  # over the edge
    (0.5, 0.1, 0.4, 0.7, 0.5, 3.0),
]


def test_the_highest_rock_is_what_stands_there():
    assert np.allclose(
        laid(STONES, heaped=False), np.max([ellipsoid(*s) for s in STONES], axis=0), atol=1e-12
    )


def test_a_rock_of_a_heap_lies_on_those_below_its_centre():
    alone, heap = laid(STONES, heaped=False), laid(STONES, heaped=True)
    middle = np.abs(AXIS[:, None] - 0.1) + np.abs(AXIS[None, :] - 0.5) < 0.06
    assert heap[middle].max() > alone[middle].max() + 0.1
    apart = np.hypot(AXIS[None, :] + 1.1, AXIS[:, None] - 1.0) < 0.5
    assert np.array_equal(heap[apart], alone[apart])


def test_a_rock_beyond_the_field_raises_nothing():
    assert not laid([(9.0, 9.0, 1.0, 0.5, 0.5, 0.0)], heaped=True).any()


def test_rocks_are_strewn_over_a_terrain():
    coarse = np.linspace(-40.0, 40.0, 41)
    flat = Terrain(coarse, coarse, np.zeros((41, 41)))
    rocky = strewn(np.random.default_rng(3), flat, 0.05)
    assert rocky.elevation.min() == 0.0
    assert 0.03 < np.mean(rocky.elevation > 0.0) < 0.09  # and some piles
