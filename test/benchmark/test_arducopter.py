# SPDX-License-Identifier: Apache-2.0
"""The verdict on the flights with ArduCopter; without the binary."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmark"))

import arducopter

from quadtree_lss.lab.simulation.safety import worst_contact
from quadtree_lss.lab.simulation.scenarios import SCENARIOS


def test_a_touchdown_is_judged_by_the_true_ground_and_by_what_was_forbidden(tmp_path):
    flight = arducopter.Flight("", 5, "", tmp_path)
    terrain, gear = flight.terrain, SCENARIOS["drone"].lander
    places = np.random.default_rng(6).uniform(-10.0, 10.0, (200, 2))
    slope, rise = worst_contact(terrain, places, gear)
    good = np.flatnonzero((slope < 0.05) & (rise < 0.03))[0]
    bad = np.flatnonzero(rise > 0.15)[0]
    for row, ground in ((good, "safe"), (bad, "unsafe")):
        flight._target = np.append(places[row] + (0.3, 0.4), 0.0)
        flight._judge(np.append(places[row], 0.0))
        assert flight.landing.ground == ground
        assert flight.landing.miss == pytest.approx(0.5)
    square = np.array([[-2.0, -2.0], [2.0, -2.0], [2.0, 2.0], [-2.0, 2.0]])
    for beside, ground in ((1.9, "withdrawn"), (2.1, "safe")):
        flight._keep_out = places[good] + square + (beside, 0.0)
        flight._judge(np.append(places[good], 0.0))
        assert flight.landing.ground == ground
