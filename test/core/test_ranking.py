# SPDX-License-Identifier: Apache-2.0
"""The order of sites: probability, and clearance among equal probabilities."""

from __future__ import annotations

from math import hypot

import numpy as np
import pytest

from quadtree_lss.onboard.core.landing.ranking import EQUAL_RISKS, MODEL_ERROR, Candidates


def candidates(cost, unsafe, clearance):
    """Return grid points 1 m apart."""
    y, x = (np.arange(float(count)) for count in cost.shape)
    return Candidates(x, y, np.isfinite(cost), cost, np.zeros(cost.shape), unsafe, clearance)


def first(risks, clearances):
    unsafe = np.array([risks])
    found = candidates(unsafe, unsafe, np.array([clearances])).best
    return None if found is None else found[1]


def test_clearance_decides_between_probabilities_that_the_model_cannot_tell_apart():
    assert first([3.72e-4, 4.28e-4], [0.5, 4.7]) == 1
    assert first([3.72e-4, 4.28e-4], [4.7, 0.5]) == 0


def test_a_probability_that_is_better_by_more_than_the_error_ranks_first():
    assert first([1e-3, 4e-3], [0.0, 10.0]) == 0


def test_risks_too_small_to_be_shown_are_equal():
    assert first([1e-7, 9e-5], [0.5, 1.0]) == 1


def test_of_equal_clearances_the_more_probable_ranks_first():
    assert first([1.1e-3, 1e-3, 1.2e-3], [2.0, 2.0, 2.0]) == 1


def test_equal_risks_differ_by_the_standard_deviation_of_their_difference():
    assert EQUAL_RISKS - 1.0 == pytest.approx(MODEL_ERROR * hypot(1.0, EQUAL_RISKS))


def test_without_candidates_none_ranks_first():
    assert first([np.nan, np.nan], [1.0, 1.0]) is None


def test_without_probabilities_the_lowest_cost_ranks_first():
    assert candidates(np.array([[2.0, 1.0]]), None, np.array([[9.0, 0.0]])).best == (0, 1)


def test_each_rank_is_the_best_among_equals_of_what_the_ranks_before_leave():
    rng = np.random.default_rng(3)
    unsafe = 10.0 ** rng.uniform(-5.0, -2.0, (20, 30))
    unsafe[rng.random(unsafe.shape) < 0.3] = np.nan
    clearance = rng.uniform(0.0, 5.0, unsafe.shape)
    ground = candidates(unsafe, unsafe, clearance)
    ranked = ground.ranked(4.0, 8)
    assert len(ranked) == 8
    left = np.fmin(unsafe, np.inf)
    for place in ranked:
        assert place == ground.rank_first(left)
        row, column = np.ogrid[:20, :30]
        near = (row - place[0]) ** 2 + (column - place[1]) ** 2 < 16.0
        assert np.isfinite(left[place])
        left[near] = np.inf


def test_risks_that_differ_by_more_than_a_hundredth_are_not_equal():
    assert first([0.27, 0.45], [0.4, 1.4]) == 0
