# SPDX-License-Identifier: Apache-2.0
"""The Morton curve: cells of every level are runs."""

from hypothesis import given
from hypothesis import strategies as st

from quadtree_lss.onboard.core.geometry import morton


@given(st.integers(0, 4095), st.integers(0, 4095))
def test_a_code_holds_the_bits_of_both_in_turn(ix, iy):
    code = morton.encode(ix, iy)
    assert code == sum(((ix >> k & 1) | (iy >> k & 1) << 1) << 2 * k for k in range(12))
    assert code == morton.SPREAD[ix] | morton.SPREAD[iy] << 1


@given(st.integers(0, 4095), st.integers(0, 4095), st.integers(0, 12))
def test_the_cell_of_a_coarser_level_is_the_front_of_the_code(ix, iy, levels):
    assert morton.encode(ix, iy) >> 2 * levels == morton.encode(ix >> levels, iy >> levels)
