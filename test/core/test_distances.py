# SPDX-License-Identifier: Apache-2.0
"""Distances on the lattice against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt

from quadtree_lss.onboard.core.landing.lattice import distance_from, grown, nearest_marked


def brute(marked: np.ndarray) -> np.ndarray:
    """Distance in steps of every point to the nearest marked one."""
    rows, columns = np.indices(marked.shape)
    out = np.full(marked.shape, np.inf)
    for row, column in np.argwhere(marked):
        out = np.minimum(out, np.sqrt((rows - row) ** 2 + (columns - column) ** 2))
    return out


def some(share: float, shape: tuple[int, int] = (19, 23)) -> np.ndarray:
    return np.random.default_rng(7).random(shape) < share


@pytest.mark.parametrize("share", [0.0, 0.004, 0.05, 0.5, 1.0])
@pytest.mark.parametrize("shape", [(19, 23), (64, 40)])
def test_distances_are_exact(share, shape):
    marked, side = some(share, shape), 0.3
    np.testing.assert_allclose(distance_from(marked, side), side * brute(marked), rtol=1e-15)


@pytest.mark.parametrize("share", [0.004, 0.05, 0.5, 1.0])
@pytest.mark.parametrize("limit", [0.0, 0.3, 1.0, 3.1, 30.0, 37.7, 37.8, 1e300])
@pytest.mark.parametrize("shape", [(19, 23), (64, 40), (300, 200), (1, 9), (9, 1)])
def test_distances_are_exact_up_to_the_limit(share, limit, shape):
    marked, side = some(share, shape), 0.3
    if not marked.any():
        marked[0, 0] = True
    expected, found = distance_from(marked, side), distance_from(marked, side, limit)
    near = expected <= limit
    np.testing.assert_array_equal(found[near], expected[near])
    assert (found[~near] > limit).all()


@pytest.mark.parametrize("share", [0.004, 0.05, 0.5, 1.0])
def test_the_place_is_that_which_scipy_finds(share):
    marked = some(share)
    found = distance_transform_edt(~marked, return_distances=False, return_indices=True)
    expected = np.ravel_multi_index(tuple(found), marked.shape)
    np.testing.assert_array_equal(nearest_marked(marked), expected)


@pytest.mark.parametrize("share", [0.0, 0.004, 0.05, 1.0])
@pytest.mark.parametrize("distance", [0.0, 0.29, 0.3, 0.6, 1.0, 3.7, 4.8, 5.1, 6.3, 50.0, 1e300])
@pytest.mark.parametrize("short", [0.0, 0.5])
def test_growth_takes_what_is_within_the_distance(share, distance, short):
    marked, side = some(share), 0.3
    expected = marked | ((brute(marked) - short) * side <= distance)
    np.testing.assert_array_equal(grown(marked, distance, side, short), expected)


@pytest.mark.parametrize("shape", [(1, 1), (2, 2), (1, 9), (300, 2)])
def test_lattices_of_any_shape(shape):
    marked = np.zeros(shape, dtype=np.bool_)
    marked[0, 0] = True
    expected = brute(marked)
    np.testing.assert_allclose(distance_from(marked, 1.0), expected)
    np.testing.assert_array_equal(grown(marked, 5.0, 1.0), expected <= 5.0)
