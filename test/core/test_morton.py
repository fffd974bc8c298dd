# SPDX-License-Identifier: Apache-2.0
"""The Morton curve: codes come back, cells of every level are runs, the sort is stable."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadtree_lss.onboard.core.geometry import morton


@given(st.integers(0, 4095), st.integers(0, 4095))
def test_a_code_holds_the_bits_of_both_in_turn(ix, iy):
    code = morton.encode(ix, iy)
    assert code == sum(((ix >> k & 1) | (iy >> k & 1) << 1) << 2 * k for k in range(12))
    assert morton.decode(np.array([code])) == (ix, iy)
    assert code == morton.SPREAD[ix] | morton.SPREAD[iy] << 1


@given(st.integers(0, 4095), st.integers(0, 4095), st.integers(0, 12))
def test_the_cell_of_a_coarser_level_is_the_front_of_the_code(ix, iy, levels):
    assert morton.encode(ix, iy) >> 2 * levels == morton.encode(ix >> levels, iy >> levels)


@pytest.mark.parametrize("count", [0, 1, 2, 1000, 100_000])
@pytest.mark.parametrize(("low", "high", "step"), [(0, 1, 1), (5, 6, 1), (0, 40, 8), (0, 2**24, 1)])
def test_order_is_that_of_a_stable_sort(count, low, high, step):
    keys = np.random.default_rng(count).integers(low, high, count) * step
    packed = keys << 32 | np.arange(count)
    spare = np.empty_like(packed)
    found = spare if morton.sort_packed(packed, spare) else packed
    np.testing.assert_array_equal(found & 0xFFFFFFFF, np.argsort(keys, kind="stable"))
