# SPDX-License-Identifier: Apache-2.0
"""Rates, means, intervals and worst flights of records made by hand."""

import numpy as np
import pytest
from scipy.stats import binom

from quadtree_lss.lab.campaign.kinds import Quantity, Record
from quadtree_lss.lab.campaign.summary import line_of, rate_interval


def _records(**columns):
    names = list(columns)
    rows = zip(*columns.values(), strict=True)
    return [
        Record(k, k, "morpheus", {}, dict(zip(names, row, strict=True)))
        for k, row in enumerate(rows)
    ]


UNSAFE = Quantity("unsafe", "Unsafe", of="judged")
SAFE = Quantity("safe", "Safe", worst="smallest", of="one")


def test_counted_events_and_the_flight_that_had_most_or_lacked_what_should_be():
    line = line_of(UNSAFE, _records(unsafe=[0, 1, 2, 0], judged=[5, 5, 4, 0]))
    assert (line.events, line.count, line.worst_flight) == (3, 14, 2)
    assert line.low < 3 / 14 < line.high and line.cells()[1] == "3 of 14"
    assert line_of(SAFE, _records(safe=[1, 1, 0, 1], one=[1] * 4)).worst_flight == 2
    assert line_of(SAFE, _records(safe=[1, 1], one=[1, 1])).worst_flight is None


def test_no_event_bounds_the_rate_and_blames_nobody_and_of_no_trial_there_is_none():
    line = line_of(UNSAFE, _records(unsafe=[0], judged=[200]))
    assert line.worst_flight is None and line.low == 0.0
    assert line.high == pytest.approx(1.0 - 0.025 ** (1 / 200))
    cells = line_of(UNSAFE, _records(unsafe=[0], judged=[0])).cells()
    assert cells == ("Unsafe", "0 of 0", "–", "–", "–")


@pytest.mark.parametrize(("events", "trials"), [(0, 100), (1, 100), (7, 20), (20, 20)])
def test_rate_interval_leaves_two_and_a_half_percent_on_each_side(events, trials):
    low, high = rate_interval(events, trials)
    assert 0.0 <= low <= events / trials <= high <= 1.0
    if events < trials:
        assert binom.cdf(events, trials, high) == pytest.approx(0.025)
    if events:
        assert binom.sf(events - 1, trials, low) == pytest.approx(0.025)
    assert np.isnan(rate_interval(0, 0)).all()
