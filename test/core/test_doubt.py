# SPDX-License-Identifier: Apache-2.0
"""Doubts of an answer: a run outside the fit, ground seen thinly, risks that do not come true."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from core.builders import BY_RISK, configured, mapped
from core.scenes import flat

from quadtree_lss.onboard.config.risk import doubt
from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.landing.assessment import MOST_BRIDGED, Hindsight, coverage
from quadtree_lss.onboard.core.landing.sites import LandingSiteSelector
from quadtree_lss.onboard.core.tree.domain import Domain

DOMAIN = Domain(0.0, 0.0, 64.0, 2, 8)
ALL = np.ones((257, 257), dtype=np.bool_)
RNG = np.random.default_rng(3)


def judged_again(first, later, domain=DOMAIN, stamps=(1, 2), judged=ALL) -> str:
    """What is said of places half a metre apart whose risks were told, and told anew."""
    hindsight = Hindsight(1.0)
    for stamp_ns, risk in zip(stamps, (first, later), strict=True):
        hindsight.take(domain, stamp_ns, np.broadcast_to(risk, judged.shape), judged)
    return hindsight.words()


def test_risks_that_do_not_come_true_are_told():
    said = judged_again(0.01, 0.04)
    assert "told 1 % of risk at first, 4 % is unsafe" in said
    assert judged_again(0.04, 0.01) == ""  # too bold is what matters


def test_noise_of_stereo_is_doubted_where_it_grows():
    stereo = {"lidar.stereo_noise": 0.08 / (380.0 * 0.05)}
    for far, doubted in ((2.0, False), (8.0, True)):
        said = doubt(config_from_values({**stereo, "lidar.max_range": far}))
        assert ("not one that grows to 0.27" in said) is doubted, said


def test_what_is_right_on_average_is_no_doubt():
    """One place in a hundred turns out to be unsafe, the others safe: what 1 % says."""
    assert judged_again(0.01, RNG.random(ALL.shape) < 0.01) == ""
    assert "told 0.1 %" in judged_again(0.001, RNG.random(ALL.shape) < 0.006)


def test_few_places_say_nothing():
    few = np.zeros_like(ALL)
    few[:9, :9] = True  # 5 x 5 places: six landers
    assert judged_again(0.01, 0.1, judged=few) == ""


@pytest.mark.parametrize("reset", [False, True])
def test_of_a_map_that_was_reset_risks_are_told_anew(reset):
    config = configured(vehicle={"diameter": 1.9}, lss=BY_RISK)

    def blocks(x, y):
        return 0.6 * ((x % 2.0 < 0.7) & (y % 2.0 < 0.7))

    selector, level = LandingSiteSelector(config), mapped(config, flat()).snapshot()
    selector.assess(level)
    if reset:
        nothing = np.zeros_like(level.observed)
        selector.assess(dataclasses.replace(level, stamp_ns=0, observed=nothing))
    found = selector.assess(dataclasses.replace(mapped(config, blocks).snapshot(), stamp_ns=9))
    assert any("do not come true" in doubt for doubt in found.doubts) is not reset


def test_another_map_or_one_begun_anew_is_not_held_against_the_last():
    assert judged_again(0.01, 0.04, stamps=(2, 1)) == ""
    hindsight = Hindsight(1.0)
    hindsight.take(dataclasses.replace(DOMAIN, xmin=0.1), 1, np.full(ALL.shape, 0.01), ALL)
    hindsight.take(DOMAIN, 2, np.full(ALL.shape, 0.04), ALL)
    assert hindsight.words() == ""


def test_ground_not_judged_then_or_now_does_not_count():
    hindsight = Hindsight(1.0)
    risks = np.where(np.arange(257) < 128, 0.01, 0.04)
    for stamp_ns, judged in enumerate((np.arange(257) < 128, np.arange(257) >= 128)):
        hindsight.take(DOMAIN, stamp_ns, np.tile(risks, (257, 1)), np.tile(judged, (257, 1)))
    assert hindsight.words() == ""


@pytest.mark.parametrize("more", [-0.02, 0.02])
def test_ground_bridged_beyond_what_was_fitted_is_told(more):
    place = np.arange(10_000).reshape(100, 100)
    judged = np.zeros((101, 101), dtype=np.bool_)
    judged[1:, 1:] = place < 8000
    bridged = (place >= 8000) | (place < 8000 * (MOST_BRIDGED + more))
    said = coverage(SimpleNamespace(bridged=bridged), judged)
    assert said.startswith("7 % of the judged ground") if more > 0.0 else said == ""


def test_an_answer_gives_its_doubts():
    """Of the shipped fit with a lander, and of a map, of another kind."""
    for lander, some in ({"diameter": 3.7}, False), ({"diameter": 20.0}, True):
        config = configured(domain={"max_level": 6}, vehicle=lander, lss=BY_RISK)
        cells = mapped(config, flat()).snapshot()
        doubts = LandingSiteSelector(config).assess(cells).doubts
        assert any("not 20" in line for line in doubts) == some
    by_limits = dataclasses.replace(config, lss=configured().lss)
    assert LandingSiteSelector(by_limits).assess(cells).doubts == ()
