# SPDX-License-Identifier: Apache-2.0
"""A leaf claims what it errs by, whatever part of it was seen, from wherever, in whatever points.

The leaves are those of ``benchmark/shares.py``: strips of 1 to 100 % of a leaf of 0.25 to 8 m,
in any direction, incidences of 0 to 75 degrees, 5 to 5,000 points a scan, plane ground or rolling.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from quadtree_lss.lab.simulation.terrain import Terrain

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmark"))

import shares

pytestmark = pytest.mark.xdist_group("shares")  # drawn once


@pytest.fixture(scope="module")
def leaves() -> list[shares.Draw]:
    """Of one scan, and of twenty."""
    return shares.draw_leaves(4501, 1500, 1) + shares.draw_leaves(4502, 400, 20)


def sizes(draws: list[shares.Draw], of: str) -> np.ndarray:
    """How many deviations measured leaves are off by."""
    return np.abs(shares.pooled(draws, of))


@pytest.mark.parametrize(
    ("of", "least", "beyond"), [("height", 0.8, 2e-3), ("slope", 0.5, 5e-4), ("all", 0.68, 1e-3)]
)
def test_errors_are_as_claimed_over_all_shares(leaves, of, least, beyond):
    """Pooled: claims are rather wide than narrow, and almost none is off."""
    ratios = sizes(leaves, of)
    assert len(ratios) > 1000
    assert least < np.sqrt(np.mean(ratios**2)) < 1.0
    assert np.mean(ratios > 4.0) < beyond


@pytest.mark.parametrize("scans", [1, 20])
@pytest.mark.parametrize(
    ("low", "high", "most", "beyond"),
    [(0.01, 0.25, 1.4, 0.012), (0.25, 0.5, 0.9, 4e-3), (0.5, 1.0, 0.8, 1e-3)],
)
def test_no_share_is_trusted_too_much(leaves, scans, low, high, most, beyond):
    """Also where cells of 0.25 m hold nothing but what noise of 0.06 m carried over the edge of the
    strip, the same way in each scan."""
    ratios = sizes([d for d in leaves if d.scans == scans and low <= d.share <= high], "all")
    assert np.sqrt(np.mean(ratios**2)) < most
    assert np.mean(ratios > 4.0) < beyond


@pytest.mark.slow
def test_claims_hold_over_rolling_ground():
    """Waves of 4 degrees: what planes leave out of the unseen part is within what leaves allow."""
    rolling = shares.draw_leaves(4503, 500, 1, 0.07) + shares.draw_leaves(4503, 130, 20, 0.07)
    ratios = sizes(rolling, "all")
    assert len(ratios) > 1000
    assert 0.6 < np.sqrt(np.mean(ratios**2)) < 1.0
    assert np.mean(ratios > 4.0) < 2e-3


@pytest.mark.slow
def test_claims_hold_over_broken_ground():
    """Bumps of 0.2 m every two metres, no plane at any size of leaf: what planes leave out makes
    slopes less certain, those of fits and those that children inherit."""
    posts, rng = 0.2 * np.arange(200.0), np.random.default_rng(1)
    bumps = gaussian_filter(rng.standard_normal((200, 200)), 4.0)
    ground = Terrain(posts, posts, 0.2 * bumps / bumps.std())
    found = shares.draw_leaves(4503, 200, 1, ground) + shares.draw_leaves(4503, 50, 20, ground)
    ratios = sizes(found, "slope")
    assert len(ratios) > 2500
    assert 0.8 < np.sqrt(np.mean(ratios**2)) < 1.25
    assert np.mean(ratios > 4.0) < 0.012


@pytest.mark.parametrize("scans", [1, 20])
def test_most_leaves_are_measured(leaves, scans):
    """A map that claims nothing is never wrong: of half of a leaf a plane is known."""
    wide = [d for d in leaves if d.scans == scans and d.share > 0.6]
    assert np.mean([len(d.found.height) > 0 for d in wide]) > 0.7
