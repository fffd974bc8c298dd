# SPDX-License-Identifier: Apache-2.0
"""A selector that followed the map from scan to scan and a new one say the same, to the bit."""

from __future__ import annotations

import numpy as np
from core.builders import configured, look, make_pose, scattered

from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.messages.maps import round_trip


def rocks(x, y):
    """Gentle waves and a few blocks of half a metre."""
    wave = 0.15 * np.sin(0.4 * x) * np.cos(0.3 * y)
    block = np.zeros(np.shape(x))
    for cx, cy in ((6.0, 9.0), (17.0, 20.0), (24.0, 5.0)):
        block += np.where((np.abs(x - cx) < 0.4) & (np.abs(y - cy) < 0.4), 0.5, 0.0)
    return wave + block


def test_what_did_not_change_need_not_be_checked_again():
    base = configured(domain={"size": 32.0, "min_level": 3, "max_level": 7})
    config = config_from_values({"lss.grid_spacing": 0.25, "vehicle.diameter": 3.0}, base)
    mapper, rng = Mapper(config), np.random.default_rng(3)
    follower = LandingSiteSelector(config)
    strips = [(0.0, 0.0, 0.0), (16.0, 0.0, 0.0), (0.0, 16.0, 0.0), (8.0, 8.0, 0.0), (0.0, 0.0, 0.0)]
    for number, (xmin, ymin, high) in enumerate((*strips, (8.0, 8.0, 100.0))):
        if high:
            mapper = Mapper(config)  # of other ground altogether
        pose = make_pose((16.0, 16.0, 300.0 + high), stamp_ns=number + 1)
        places = scattered(rng, xmin, ymin, 16.0, 12000)
        look(mapper, lambda x, y, high=high: rocks(x, y) + high, *places, rng, 0.05, pose)
        cells = round_trip(mapper.snapshot())
        followed = follower.assess(cells)
        anew = LandingSiteSelector(config).assess(cells)
        np.testing.assert_array_equal(followed.hazard, anew.hazard)
        np.testing.assert_array_equal(followed.safe, anew.safe)
        np.testing.assert_array_equal(followed.score, anew.score)
        np.testing.assert_array_equal(followed.sites.position, anew.sites.position)
        assert ((anew.hazard & 8) > 0).any()
