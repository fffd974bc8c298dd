# SPDX-License-Identifier: Apache-2.0
"""Mean, worst and intervals over seeds."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from quadtree_lss.lab.campaign.statistics import rate_interval, summarise, upper_bound


def test_mean_worst_and_whose_it_is():
    smallest = summarise([7, 8, 9], [0.9, 0.5, 1.0], "smallest")
    assert (smallest.worst, smallest.worst_seed, smallest.count) == (0.5, 8, 3)
    assert smallest.mean == pytest.approx(0.8)
    assert summarise([7, 8, 9], [0.9, 0.5, 1.0], "largest").worst_seed == 9


def test_interval_holds_the_mean_about_as_often_as_it_says():
    generator = np.random.default_rng(3)
    inside = 0
    for _ in range(200):
        s = summarise(list(range(20)), generator.normal(5.0, 2.0, 20), "smallest")
        inside += s.low <= 5.0 <= s.high
    assert 0.87 <= inside / 200 <= 0.99


def test_equal_values_leave_no_doubt():
    s = summarise([1, 2, 3], [4.0, 4.0, 4.0], "largest")
    assert (s.low, s.mean, s.high) == (4.0, 4.0, 4.0)


def test_one_value_tells_no_spread():
    s = summarise([7], [0.9], "smallest")
    assert (s.mean, s.worst, s.worst_seed, s.count) == (0.9, 0.9, 7, 1)
    assert np.isnan([s.low, s.high]).all()


def test_missing_values_are_left_out():
    s = summarise([1, 2, 3], [np.nan, 2.0, 4.0], "smallest")
    assert (s.mean, s.worst, s.worst_seed, s.count) == (3.0, 2.0, 2, 2)
    nothing = summarise([1], [np.nan], "smallest")
    assert nothing.count == 0
    assert nothing.worst_seed is None
    assert np.isnan(nothing.mean)


@pytest.mark.parametrize(("events", "trials"), [(0, 100), (1, 100), (7, 20)])
def test_bound_is_the_rate_at_which_so_few_become_unlikely(events, trials):
    assert binom.cdf(events, trials, upper_bound(events, trials)) == pytest.approx(0.05)


def test_bound_at_the_ends():
    assert upper_bound(5, 5) == 1.0
    assert np.isnan(upper_bound(0, 0))


@pytest.mark.parametrize(("events", "trials"), [(0, 100), (1, 100), (7, 20), (20, 20)])
def test_rate_interval_leaves_two_and_a_half_percent_on_each_side(events, trials):
    low, high = rate_interval(events, trials)
    assert 0.0 <= low <= events / trials <= high <= 1.0
    if events < trials:
        assert binom.cdf(events, trials, high) == pytest.approx(0.025)
    if events:
        assert binom.sf(events - 1, trials, low) == pytest.approx(0.025)
    assert np.isnan(rate_interval(0, 0)).all()
