# SPDX-License-Identifier: Apache-2.0
"""What was found in a sentence, with a site and without."""

import re

import numpy as np
import pytest
from report.pages import changed

from quadtree_lss.desk.exchange.saved import load_results
from quadtree_lss.desk.report import headline
from quadtree_lss.desk.report.report import page
from quadtree_lss.onboard.config.settings import config_from_values


@pytest.fixture
def content(result):
    return load_results(result.out)


def without_sites(content, hazard):
    """The same grid with these hazards, and no site."""
    grid = {**content.grid, "hazard": hazard, "safe": np.zeros(hazard.shape, bool)}
    sites = {name: values[:0] for name, values in content.sites.items()}
    summary = {**content.summary, "explanation": "no safe site: nothing fits", "reasons": []}
    return changed(content, grid=grid, sites=sites, summary=summary)


def test_the_share_is_of_the_seen_ground(content):
    found = headline.areas(content)
    size = content.config.domain.size
    assert 0.0 < found.allowed < found.seen <= size**2
    everything = changed(
        content, grid={**content.grid, "hazard": np.zeros_like(content.grid["hazard"])}
    )
    assert headline.areas(everything).seen == pytest.approx(size**2)
    words, ground = headline.headline(content)
    assert f"at the best of {len(content.sites['x'])} sites" in words
    share = 100 * found.allowed / found.seen
    assert f"allowed on {share:.0f} % of the {found.seen:,.0f} m² seen" in ground
    why = content.reasons[0].partition(": ")[2]  # without its probability, which the words have
    assert f" m. {why[:1].upper()}{why[1:]}. Landing is" in ground


def test_little_is_not_nothing():
    said = {0.0: "0", 0.0937: "0.094", 0.294: "0.29", 9.96: "10", 2451.6: "2,452"}
    assert [headline.few(value) for value in said] == list(said.values())


def test_no_site_names_the_largest_circle_and_what_ends_it(content):
    """Clear ground about one place only: a disc of 1.2 m in touchdown hazards."""
    x, y = np.meshgrid(content.grid["x"], content.grid["y"])
    row, column = (n // 2 for n in x.shape)
    away = np.hypot(x - x[row, column], y - y[row, column])
    found = without_sites(content, np.where(away < 1.2, 0, 8).astype(np.uint8))
    circle = headline.largest_circle(found)
    assert (circle.x, circle.y) == (x[row, column], y[row, column])
    assert (
        circle.radius == pytest.approx(1.2, abs=content.grid.spacing) and circle.limit == "hazards"
    )
    unseen = without_sites(content, np.where(away < 1.2, 0, 128).astype(np.uint8))
    assert headline.largest_circle(unseen).limit == "unseen ground"
    unmapped = without_sites(content, np.where(away < 1.2, 0, 192).astype(np.uint8))
    assert headline.largest_circle(unmapped).limit == "ground not yet mapped"
    more = headline.areas(unmapped).unmapped
    assert f"; {more:,.0f} m² more are seen, not yet mapped" in headline.headline(unmapped)[1]
    words, text = headline.headline(found)
    assert words == "No landing site." and text.startswith(headline.shortfall(found))
    assert headline.shortfall(found) and "othing fits" not in text
    nothing = without_sites(content, np.full_like(content.grid["hazard"], 128))
    assert headline.headline(nothing)[1] == "Nothing fits."
    assert "Largest circle of clear ground" in text and "are needed" in text


def test_the_nearest_miss_is_the_most_level_or_the_likeliest(content):
    slope = np.full(content.grid["hazard"].shape, 12.0)
    slope[30, 20] = 9.5
    found = without_sites(content, np.full_like(content.grid["hazard"], 8))
    grid = {k: v for k, v in found.grid.items() if k not in ("probability", "risk")}
    found = changed(found, grid={**grid, "slope_deg": slope})
    miss = headline.nearest_miss(found)
    assert (miss.x, miss.y) == (content.grid["x"][20], content.grid["y"][30])
    assert "9.5 deg" in miss.why
    likely = np.full(slope.shape, 0.1)
    likely[25, 35] = 0.4
    found = changed(found, grid={**found.grid, "probability": likely})
    miss = headline.nearest_miss(found)
    assert (miss.x, miss.y) == (content.grid["x"][35], content.grid["y"][25])
    assert miss.why == "probability 40 %"


def test_where_there_are_sites_nothing_is_missed(content):
    assert headline.nearest_miss(content) is None and headline.largest_circle(content) is None


def test_no_probability_is_rounded_to_certainty(content):
    sure = {**content.sites, "probability": np.full_like(content.sites["x"], 1.0 - 1e-9)}
    reasons = {**content.summary, "reasons": ["level"] * len(sure["x"])}
    found = changed(content, sites=sure, summary=reasons)
    assert "99.99 % at the best of" in headline.headline(found)[0]


@pytest.mark.parametrize(
    ("best", "doubts", "level", "words"),
    [
        (0.995, [], "good", "Good: 99.5 % at the best of 5 sites."),
        (0.995, ["another lander"], "care", "With care: 99.5 % at the best of 5 sites."),
        (0.93, [], "care", "With care: 93.0 % at the best of 5 sites."),
        (0.2, [], "none", "None is good enough: 20.0 % at the best of 5 sites, and a target needs"),
    ],
)
def test_sites_are_as_good_as_the_probability_of_the_best(content, best, doubts, level, words):
    sites = {name: np.resize(values, 5) for name, values in content.sites.items()}
    sites["probability"] = np.linspace(best, best - 0.1, 5)
    summary = {**content.summary, "doubts": doubts, "reasons": ["level"] * 5}
    found = changed(content, sites=sites, summary=summary)
    assert headline.trust(found)[0] == level and headline.headline(found)[0].startswith(words)
    facts = {fact.name: fact for fact in headline.trust(found)[1]}
    assert facts["within the fit"].level == ("care" if doubts else "good")
    assert facts["best aim"].level == ("good" if best > 0.99 else level)
    shown = page(found)
    assert f'class="verdict {level}"' in shown and f"<dd>{facts['best aim'].value}</dd>" in shown


def test_ground_is_allowed_and_only_a_touchdown_is_safe(text):
    """One word for the risk of a place, another one for the probability of an aim."""
    words = re.sub(r"<(script|style|details)\b.*?</\1>|<[^>]*>", " ", text, flags=re.DOTALL)
    assert {m[1] for m in re.finditer(r"\bsafe\W+(\w+)", words)} <= {"touchdown"}


def test_without_a_site_the_limit_is_named_and_by_how_much(content):
    """Too little seen, too great a risk, too steep; the first that is in the way."""
    found = without_sites(content, np.full_like(content.grid["hazard"], 128))
    assert headline.shortfall(found) == ""  # nothing at all is seen
    hazard = found.grid["hazard"].copy()
    hazard[20:25, 20:25] = 0
    found = without_sites(content, hazard)
    room = 3.0 * content.grid.spacing
    short = f"The widest seen ground is {content.zone - room:.2f} m short"
    assert headline.shortfall(found).startswith(short)
    config = config_from_values({"lss.max_risk": 0.01}, content.config)
    content = changed(content, config=config)
    found = without_sites(content, np.full_like(hazard, 8))
    risky = np.full(hazard.shape, 0.5)
    risky[30, 30] = 0.03
    found = changed(found, grid={**found.grid, "risk": risky})
    assert headline.shortfall(found).endswith("3 times the allowed 1 % (lss.max_risk)")
    level = {**found.grid, "risk": np.zeros(hazard.shape), "slope_deg": np.full(hazard.shape, 13.0)}
    found = changed(found, grid=level)
    over = 13.0 - content.config.vehicle.max_slope_deg
    assert f"{over:.1f} deg over the limit" in headline.shortfall(found)
    assert headline.shortfall(found) in headline.headline(found)[1]
