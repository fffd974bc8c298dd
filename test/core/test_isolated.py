# SPDX-License-Identifier: Apache-2.0
"""Isolated returns: strays go, alone or by twos; the edges of what is sound stay."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from quadtree_lss.onboard.core.sensing.isolated import (
    find_isolated,
    isolated_in_image,
    isolated_in_space,
    typical_distance,
)


def isolated(points: np.ndarray, gate: float = 0.4) -> np.ndarray:
    """Mask (H, W) or (N,) of the isolated among points (H, W, 3) or (N, 3)."""
    ranges = np.linalg.norm(points, axis=-1)
    if points.ndim == 3:
        places = isolated_in_image(ranges, gate)
    else:
        places = isolated_in_space(points, ranges, gate)
    assert (np.diff(places) > 0).all()
    out = np.zeros(ranges.size, dtype=bool)
    out[places] = True
    return out.reshape(ranges.shape)


@pytest.mark.parametrize("returns", [0, 1, 2])
def test_too_few_returns_are_not_judged(returns):
    points = np.full((4, 4, 3), np.nan)
    points.reshape(-1, 3)[:returns] = np.outer(range(1, returns + 1), (0.0, 0.0, 10.0))
    assert not isolated(points).any()
    assert not isolated(points.reshape(-1, 3)).any()


def in_groups_of_fewer_than_three(count: int, pairs: np.ndarray) -> np.ndarray:
    """Mask (count,) by brute force: connected components of the links ``pairs`` (M, 2)."""
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(count, count))
    _, label = connected_components(links, directed=False)
    return np.bincount(label)[label] < 3


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 20), st.integers(1, 20), st.floats(0.0, 0.9))
def test_in_an_image_groups_of_fewer_than_three_are_isolated(seed, height, width, missing):
    rng = np.random.default_rng(seed)
    ranges = 400.0 + 10.0 * rng.integers(0, 3, (height, width))
    ranges[rng.random(ranges.shape) < missing] = np.nan
    pixel = np.arange(ranges.size).reshape(ranges.shape)
    sides = [(np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])]
    pairs = [np.stack([pixel[a], pixel[b]])[:, ranges[a] == ranges[b]] for a, b in sides]
    expected = in_groups_of_fewer_than_three(ranges.size, np.concatenate(pairs, axis=1).T)
    pixels = np.empty(ranges.size, dtype=np.int32)
    found = np.zeros(ranges.size, dtype=bool)
    found[pixels[: find_isolated(ranges, 1.0, pixels)]] = True
    np.testing.assert_array_equal(found, expected & np.isfinite(ranges.ravel()))


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(3, 400), st.floats(0.3, 30.0))
def test_in_space_groups_of_fewer_than_three_are_isolated(seed, count, size):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5 * size, 0.5 * size, (count, 3))
    points[: count // 2] = 0.2 * rng.normal(size=(count // 2, 3))
    gate = max(1.0, 5.0 * typical_distance(points))
    pairs = cKDTree(points).query_pairs(gate, output_type="ndarray")
    expected = in_groups_of_fewer_than_three(count, pairs)
    np.testing.assert_array_equal(isolated(points, 1.0), expected)
