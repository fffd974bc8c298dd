# SPDX-License-Identifier: Apache-2.0
"""What was found in a sentence, with a site and without."""

import re

import numpy as np
import pytest
from report.pages import changed

from quadtree_lss.desk.exchange.saved import load_results
from quadtree_lss.desk.report import headline
from quadtree_lss.desk.report.report import page


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
    found = headline.areas(content, headline.last_moment(content))
    size = content.config.domain.size
    assert 0.0 < found.allowed < found.seen <= size**2
    everything = changed(
        content, grid={**content.grid, "hazard": np.zeros_like(content.grid["hazard"])}
    )
    assert headline.areas(everything, headline.last_moment(everything)).seen == pytest.approx(
        size**2
    )
    _, words, ground, _ = headline.verdict(content)
    assert f"site 1, the best of {len(content.sites['x'])}, succeeds" in words
    share = 100 * found.allowed / found.seen
    assert f"allowed on {share:.0f} % of the {found.seen:,.0f} m² observed" in ground
    why = content.reasons[0].partition(": ")[2]  # without its probability, which the words have
    assert f" m: {why}. Landing is" in ground


def test_without_a_site_the_nearest_miss_is_named(content):
    """Clear ground about one place only: a disc of 1.2 m in touchdown hazards."""
    x, y = np.meshgrid(content.grid["x"], content.grid["y"])
    row, column = (n // 2 for n in x.shape)
    away = np.hypot(x - x[row, column], y - y[row, column])
    unmapped = without_sites(content, np.where(away < 1.2, 0, 192).astype(np.uint8))
    more = headline.areas(unmapped, headline.last_moment(unmapped)).unmapped
    said = headline.verdict(unmapped).ground
    assert f"; {more:,.0f} m² more are observed but not estimated" in said
    found = headline.verdict(without_sites(content, np.where(away < 1.2, 0, 8).astype(np.uint8)))
    assert found.answer == "No landing site." and "Nearest miss at x " in found.ground
    nothing = without_sites(content, np.full_like(content.grid["hazard"], 128))
    assert headline.verdict(nothing).ground == "Nothing fits."


@pytest.mark.parametrize(
    ("best", "doubts", "around", "level", "words"),
    [
        (
            0.995,
            [],
            1.0,
            "good",
            "Good: a touchdown at site 1, the best of 5, succeeds with 99.5 %.",
        ),
        (0.995, ["another lander"], 1.0, "care", "its risk may be wrong"),
        (0.995, [], 0.01, "care", "of the ground within"),
        (0.93, [], 1.0, "care", "succeeds with 93.0 %, but that is less than 99.0 %"),
        (0.2, [], 1.0, "none", "Not good enough: a touchdown at site 1, the best of 5, succeeds"),
    ],
)
def test_a_rating_is_of_probability_surroundings_and_model(
    content, best, doubts, around, level, words
):
    sites = {name: np.resize(values, 5) for name, values in content.sites.items()}
    sites["probability"] = np.linspace(best, best - 0.1, 5)
    summary = {**content.summary, "doubts": doubts, "reasons": ["level"] * 5}
    safe = np.full(content.grid["safe"].shape, around == 1.0)
    x, y = sites["x"][0], sites["y"][0]
    safe |= (content.grid.x == x) & (content.grid.y == y)[:, None]
    grid = {**content.grid, "safe": safe}
    found = changed(content, sites=sites, summary=summary, grid=grid)
    told = headline.verdict(found)
    assert told.level == level and words in told.answer
    facts = {fact.name: fact for fact in told.facts}
    assert facts["risk model"].level == ("care" if doubts else "good")
    assert facts["allowed around site 1"].level == ("good" if around == 1.0 else "care")
    assert headline.ratings(found, headline.last_moment(found))[0][0] == level
    shown = page(found)
    assert f'class="verdict {level}"' in shown
    for fact in told.facts:
        assert f"<dd>{fact.value}</dd>" in shown


def test_ranks_are_explained_by_probability_and_room():
    def words(probability, clear):
        table = {"probability": np.array(probability), "hazard_distance": np.array(clear)}
        return headline.rank_reasons(table)

    assert words([0.9996, 0.9995, 0.998], [4.7, 0.5, 9.0]) == [
        "most probable",
        "as probable as 1, less room",
        "less probable than 2",
    ]
    assert words([0.9995, 0.9996], [4.7, 0.5])[0] == "as probable as any, most room"
    assert words([0.9996, 0.9995], [8.0, 9.0])[1] == "as probable as 1"
    assert words([np.nan, np.nan], [1.0, 1.0]) == ["lowest score", "higher score"]
    assert words([], []) == []
    table = {"probability": np.array([0.99, 0.9]), "hazard_distance": np.array([1.0, 2.0])}
    near = headline.rank_reasons(table, wanted=True)
    assert near == ["near the planned point", "farther from the planned point"]


def test_ground_is_allowed_and_only_a_touchdown_is_safe(text):
    """One word for the risk of a place, another one for the probability of an aim."""
    words = re.sub(r"<(script|style|details)\b.*?</\1>|<[^>]*>", " ", text, flags=re.DOTALL)
    assert {m[1] for m in re.finditer(r"\bsafe\W+(\w+)", words)} <= {"touchdown"}
