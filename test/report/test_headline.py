# SPDX-License-Identifier: Apache-2.0
"""What was found in a sentence, with a site and without."""

import dataclasses

import numpy as np
import pytest

from quadtree_lss.desk.report import headline
from quadtree_lss.desk.report.content import read


@pytest.fixture
def content(result):
    return read(result.out)


def without_sites(content, hazard):
    """The same grid with these hazards, and no site."""
    grid = {**content.grid, "hazard": hazard, "safe": np.zeros(hazard.shape, bool)}
    sites = {name: values[:0] for name, values in content.sites.items()}
    summary = {**content.summary, "explanation": "no safe site: nothing fits", "reasons": []}
    return dataclasses.replace(content, grid=grid, sites=sites, summary=summary)


def test_the_share_is_of_the_seen_ground(content):
    found = headline.areas(content)
    size = content.config.domain.size
    assert 0.0 < found.safe < found.seen <= size**2
    everything = dataclasses.replace(
        content, grid={**content.grid, "hazard": np.zeros_like(content.grid["hazard"])}
    )
    assert headline.areas(everything).seen == pytest.approx(size**2)
    words, ground = headline.headline(content)
    assert words == f"{len(content.sites['x'])} landing sites."
    assert f"{100 * found.share:.0f} % of the {found.seen:,.0f} m² seen is safe" in ground
    assert content.reasons[0] in ground


def test_no_site_names_the_largest_circle_and_what_ends_it(content):
    """Clear ground about one place only: a disc of 1.2 m in touchdown hazards."""
    x, y = np.meshgrid(content.grid["x"], content.grid["y"])
    row, column = (n // 2 for n in x.shape)
    away = np.hypot(x - x[row, column], y - y[row, column])
    found = without_sites(content, np.where(away < 1.2, 0, 8).astype(np.uint8))
    circle = headline.largest_circle(found)
    assert (circle.x, circle.y) == (x[row, column], y[row, column])
    assert circle.radius == pytest.approx(1.2, abs=content.spacing) and circle.limit == "hazards"
    unseen = without_sites(content, np.where(away < 1.2, 0, 128).astype(np.uint8))
    assert headline.largest_circle(unseen).limit == "unseen ground"
    unmapped = without_sites(content, np.where(away < 1.2, 0, 192).astype(np.uint8))
    assert headline.largest_circle(unmapped).limit == "ground not yet mapped"
    more = headline.areas(unmapped).unmapped
    assert f"; {more:,.0f} m² more are seen, not yet mapped" in headline.headline(unmapped)[1]
    words, text = headline.headline(found)
    assert words == "No safe site." and text.count("Nothing fits") == 1
    assert "Largest circle of clear ground" in text and "are needed" in text


def test_the_nearest_miss_is_the_most_level_or_the_likeliest(content):
    slope = np.full(content.grid["hazard"].shape, 12.0)
    slope[30, 20] = 9.5
    found = without_sites(content, np.full_like(content.grid["hazard"], 8))
    grid = {k: v for k, v in found.grid.items() if k not in ("probability", "risk")}
    found = dataclasses.replace(found, grid={**grid, "slope_deg": slope})
    miss = headline.nearest_miss(found)
    assert (miss.x, miss.y) == (content.grid["x"][20], content.grid["y"][30])
    assert "9.5 deg" in miss.why
    likely = np.full(slope.shape, 0.1)
    likely[25, 35] = 0.4
    found = dataclasses.replace(found, grid={**found.grid, "probability": likely})
    miss = headline.nearest_miss(found)
    assert (miss.x, miss.y) == (content.grid["x"][35], content.grid["y"][25])
    assert miss.why == "probability 40%"


def test_where_there_are_sites_nothing_is_missed(content):
    assert headline.nearest_miss(content) is None and headline.largest_circle(content) is None


def test_no_probability_is_rounded_to_certainty(content):
    sure = {**content.sites, "probability": np.full_like(content.sites["x"], 1.0 - 1e-9)}
    reasons = {**content.summary, "reasons": ["level"] * len(sure["x"])}
    found = dataclasses.replace(content, sites=sure, summary=reasons)
    assert ", probability 99.99 %: level." in headline.headline(found)[1]
