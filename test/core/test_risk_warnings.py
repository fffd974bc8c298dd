# SPDX-License-Identifier: Apache-2.0
"""Warnings about the predicted risks: a run outside the fit, ground with too few returns."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from core.builders import BY_RISK, configured, mapped
from core.scenes import flat

from quadtree_lss.onboard.config.risk import model_warning
from quadtree_lss.onboard.config.settings import Config, config_from_values
from quadtree_lss.onboard.core.landing.assess import LandingSiteSelector
from quadtree_lss.onboard.core.landing.risk import MAX_BRIDGED, risk_warnings


def test_stereo_noise_that_grows_with_range_is_outside_the_fit():
    stereo = {"lidar.stereo_noise": 0.08 / (380.0 * 0.05)}
    for max_range, outside in ((2.0, False), (8.0, True)):
        line = model_warning(config_from_values({**stereo, "lidar.max_range": max_range}))
        assert ("not one that grows to 0.27" in line) is outside, line


@pytest.mark.parametrize("more", [-0.02, 0.02])
def test_more_bridged_ground_than_in_the_fit_gives_a_warning(more):
    place = np.arange(10_000).reshape(100, 100)
    judged = np.zeros((101, 101), dtype=np.bool_)
    judged[1:, 1:] = place < 8000
    bridged = (place >= 8000) | (place < 8000 * (MAX_BRIDGED + more))
    lines = risk_warnings(Config(), SimpleNamespace(bridged=bridged, assessable=judged))
    assert [line[:24] for line in lines] == ["7 % of the judged ground"] * (more > 0.0)


def test_an_assessment_warns_only_outside_the_fit_of_the_risk_it_uses():
    for lander, outside in ({"diameter": 3.7}, False), ({"diameter": 20.0}, True):
        config = configured(domain={"max_level": 6}, vehicle=lander, lss=BY_RISK)
        cells = mapped(config, flat()).snapshot()
        warnings = LandingSiteSelector(config).assess(cells).warnings
        assert any("not 20" in line for line in warnings) == outside
    by_limits = dataclasses.replace(config, lss=configured().lss)
    assert LandingSiteSelector(by_limits).assess(cells).warnings == ()
