# SPDX-License-Identifier: Apache-2.0
"""What was found in a sentence, with a site and without."""

import re

import numpy as np
import pytest
from report.pages import changed

from quadtree_lss.desk.exchange.saved import load_results
from quadtree_lss.desk.report import headline
from quadtree_lss.desk.report.report import page
from quadtree_lss.onboard.core.landing.result import shown


@pytest.fixture
def content(result):
    return load_results(result.out)


def without_sites(content, hazard):
    """The same grid with these hazards, and no site."""
    grid = {**content.grid, "hazard": hazard, "safe": np.zeros(hazard.shape, bool)}
    sites = {name: values[:0] for name, values in content.sites.items()}
    summary = {**content.summary, "explanation": "no safe site: nothing fits", "reasons": []}
    history = {**content.history, "target": np.zeros((1, 5))}
    return changed(content, grid=grid, sites=sites, history=history, summary=summary)


def test_the_share_is_of_the_seen_ground(content):
    seen, allowed, _ = headline.areas(content, headline.last_moment(content))
    size = content.config.domain.size
    assert 0.0 < allowed < seen <= size**2
    everything = changed(
        content, grid={**content.grid, "hazard": np.zeros_like(content.grid["hazard"])}
    )
    moment = headline.last_moment(everything)
    assert headline.areas(everything, moment)[0] == pytest.approx(size**2)
    ground = headline.verdict(content).ground
    assert f"allowed on {100 * allowed / seen:.0f} % of the {seen:,.0f} m² observed" in ground


def targeted(content, away, probability=0.995, why="target 3 (99.5 %): first choice", **summary):
    """The same results with a target ``away`` m east of site 1."""
    x, y, z = content.positions[0]
    targets = content.history["target"].copy()
    targets[-2:, 0], targets[-1] = 0.0, (3.0, x + away, y, z, probability)
    reason = f"probability {shown(probability)}; 80 % of the risk comes from obstacles;"
    reason += " slope 1.0° of 10°"
    summary = {"target_why": why, **summary}
    summary = {**content.summary, "target_reason": reason, "doubts": [], **summary}
    return changed(content, history={**content.history, "target": targets}, summary=summary)


def test_it_says_where_to_land_and_the_relation_of_the_target_to_the_sites(content):
    x, y, z = content.positions[0]
    success = "the probability of a safe touchdown there is 99.5 %."
    count = len(content.positions)
    verdict = headline.verdict(targeted(content, 0.0))
    assert f" at x {x:.2f}, y {y:.2f}, z {z:.2f} m; {success}" in verdict.answer
    relation = rf"It is site 1 of {count}: [\w, ]+; [\w, ]+. Against it: 80 % of the risk"
    assert re.match(relation, verdict.ground)
    assert "comes from obstacles. Ground: slope 1.0° of 10°. Landing is" in verdict.ground
    why = "site 1 (99.5 %, 0.6 m away) gains less than the divert costs"
    held = targeted(content, 0.6, why=f"target 3 (99.5 %): {why}")
    targets = held.history["target"][[*range(len(held.history["target"]) - 1), -1, -1]]
    history = {**held.history, "target": targets}
    verdict = headline.verdict(changed(held, history=history))
    assert f" at x {x + 0.6:.2f}, y {y:.2f}, z {z:.2f} m; {success}" in verdict.answer
    relation = f"It is target 3, held from an earlier assessment, 0.6 m from site 1 of {count}"
    relation += f": {why}."
    assert verdict.ground.startswith(relation)
    assert verdict.facts[0][:2] == ("success at the target", "99.5 %")


def test_a_reason_has_the_probability_of_the_table_and_the_source_of_the_risk(content):
    for probability, reason in zip(content.sites["probability"], content.reasons, strict=True):
        assert reason.startswith(f"probability {shown(probability)}; ")
        source = r"\d+ % of the risk comes from [a-z ]+; slope"
        assert probability >= 0.9999 or re.search(source, reason)


def test_it_says_why_there_is_no_target_yet(content):
    why = "safe ground waits for the confirmation by another assessment"
    found = targeted(content, 0.0, why=f"no target: {why}")
    history = {**found.history, "target": 0.0 * found.history["target"]}
    verdict = headline.verdict(changed(found, history=history))
    x, y, _ = content.positions[0]
    count = len(content.positions)
    assert (
        f": no target: {why}; the probability of a safe touchdown at site 1 of {count}, x {x:.2f}"
        in verdict.answer
    )
    assert verdict.level != "good"


def test_the_vehicle_is_named_and_stamps_from_zero_are_seconds(content):
    facts = {fact.name: fact.value for fact in headline.verdict(content).facts}
    assert facts["vehicle, diameter"] == "3.7 m, clearance 0.3 m"
    stamps = {20_500_000_000: "20.500 s", 1_700_000_000_000_000_000: "2023-11-14 22:13:20 UTC"}
    for stamp, text in stamps.items():
        then = changed(content, summary={**content.summary, "last_stamp_ns": stamp})
        assert headline.when(then).endswith(f"· {text}")


def test_without_a_site_the_nearest_miss_is_named(content):
    """Clear ground about one place only: a disc of 1.2 m in touchdown hazards."""
    x, y = np.meshgrid(content.grid["x"], content.grid["y"])
    row, column = (n // 2 for n in x.shape)
    away = np.hypot(x - x[row, column], y - y[row, column])
    unmapped = without_sites(content, np.where(away < 1.2, 0, 192).astype(np.uint8))
    more = headline.areas(unmapped, headline.last_moment(unmapped))[2]
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
            "Good: land at x",
        ),
        (0.995, ["another lander"], 1.0, "care", "the risk model does not fit"),
        (0.995, [], 0.01, "care", "of the ground within"),
        (0.93, [], 1.0, "care", "is 93.0 %, but a good site needs 99.0 %"),
        (0.2, [], 1.0, "none", "Not good enough: the target is at x"),
    ],
)
def test_a_rating_is_of_probability_surroundings_and_model(
    content, best, doubts, around, level, words
):
    sites = {name: np.resize(values, 5) for name, values in content.sites.items()}
    sites["probability"] = np.linspace(best, best - 0.1, 5)
    summary = {"doubts": doubts, "reasons": ["level"] * 5}
    safe = np.full(content.grid["safe"].shape, around == 1.0)
    x, y = sites["x"][0], sites["y"][0]
    safe |= (content.grid.x == x) & (content.grid.y == y)[:, None]
    grid = {**content.grid, "safe": safe}
    found = changed(targeted(content, 0.0, best, **summary), sites=sites, grid=grid)
    verdict = headline.verdict(found)
    assert verdict.level == level and words in verdict.answer
    facts = {fact.name: fact for fact in verdict.facts}
    assert facts["risk model"].level == ("care" if doubts else "good")
    assert facts["allowed around the target"].level == ("good" if around == 1.0 else "care")
    assert headline.ratings(found)[0][0] == level
    shown = page(found)
    assert f'class="verdict {level}"' in shown
    for fact in verdict.facts:
        assert f"<dd>{fact.value}</dd>" in shown


def test_ranks_are_explained_by_the_shown_probability_and_room(content):
    def words(probability, room, **landing):
        sites = {"probability": np.array(probability), "hazard_distance": np.array(room)}
        summary = {**content.summary, "landing": landing}
        return headline.rank_reasons(changed(content, sites=sites, summary=summary))

    assert words([0.9996, 0.9995, 0.998], [4.7, 0.5, 9.0]) == [
        "most probable",
        "equal to 1, less room",
        "less probable than 2",
    ]
    assert words([0.9995, 0.9996], [4.7, 0.5])[0] == "equal to 2, most room"
    assert words([0.9995, 0.9996], [4.7, 4.7])[0] == "equal to 2"
    far = headline.enough_room(content)
    assert words([0.99961, 0.9996, 0.9995], [far, far + 9.0, far + 1.0])[1:] == [
        "equal to 1, ample room",
        "less probable than 2",
    ]
    assert words([np.nan, np.nan], [1.0, 1.0]) == ["lowest score", "higher score"]
    assert words([], []) == []
    near = words([0.99, 0.9], [1.0, 2.0], target=[0.0, 0.0])
    assert near == ["near the planned point", "farther from the planned point"]


def test_ground_is_allowed_and_only_a_touchdown_is_safe(text):
    """One word for the risk of a place, another one for the probability of an aim."""
    words = re.sub(r"<(script|style|details)\b.*?</\1>|<[^>]*>", " ", text, flags=re.DOTALL)
    assert {m[1] for m in re.finditer(r"\bsafe\W+(\w+)", words)} <= {"touchdown"}
