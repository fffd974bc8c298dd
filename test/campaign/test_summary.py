# SPDX-License-Identifier: Apache-2.0
"""Rates, means and worst flights of records made by hand."""

from __future__ import annotations

import pytest

from quadtree_lss.lab.campaign.kinds import Quantity
from quadtree_lss.lab.campaign.store import Record
from quadtree_lss.lab.campaign.summary import line_of


def _records(**columns):
    names = list(columns)
    rows = zip(*columns.values(), strict=True)
    return [
        Record(k, k, "morpheus", {}, dict(zip(names, row, strict=True)))
        for k, row in enumerate(rows)
    ]


def test_counted_events_name_the_flight_that_had_most():
    records = _records(unsafe=[0, 1, 2, 0], judged=[5, 5, 4, 0])
    line = line_of(Quantity("unsafe", "Unsafe", of="judged"), records)
    assert (line.events, line.count, line.worst_flight) == (3, 14, 2)
    assert line.low < 3 / 14 < line.high
    assert line.cells()[1] == "3 of 14"


def test_what_was_never_tried_has_no_rate():
    quantity = Quantity("unsafe", "Unsafe", of="judged")
    cells = line_of(quantity, _records(unsafe=[0], judged=[0])).cells()
    assert cells == ("Unsafe", "0 of 0", "–", "–", "–")


def test_of_what_should_happen_the_flight_that_lacks_it_is_named():
    quantity = Quantity("safe", "Safe", worst="smallest", of="one")
    assert line_of(quantity, _records(safe=[1, 1, 0, 1], one=[1] * 4)).worst_flight == 2
    assert line_of(quantity, _records(safe=[1, 1], one=[1, 1])).worst_flight is None


def test_no_event_bounds_the_rate_and_blames_nobody():
    line = line_of(Quantity("unsafe", "Unsafe", of="judged"), _records(unsafe=[0], judged=[200]))
    assert line.worst_flight is None and line.low == 0.0
    assert line.high == pytest.approx(1.0 - 0.025 ** (1 / 200))


def test_a_figure_that_a_flight_lacks_is_left_out():
    line = line_of(Quantity("rms", "RMS", "m"), _records(rms=[0.1, None, 0.3]))
    assert (line.mean, line.worst, line.worst_flight, line.count) == (0.2, 0.3, 2, 2)
    assert line.cells()[0] == "RMS [m]"
