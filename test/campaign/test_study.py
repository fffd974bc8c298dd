# SPDX-License-Identifier: Apache-2.0
"""Studies: which flights there are, and that each is decided by its number alone; those of the
repository can be flown, and the small one is."""

import dataclasses
import re
from pathlib import Path

import pytest

from quadtree_lss.lab.campaign.engine import campaign, fly, key_of
from quadtree_lss.lab.campaign.flights import FLY, settings_of
from quadtree_lss.lab.campaign.kinds import FILES, CampaignError
from quadtree_lss.lab.campaign.study import parse_seeds, read_study

VARIED = """
name: varied
scenario: parabola
config: parabola
seed: 30000
flights: 40
conditions:
  duration: 2
  range_noise: {uniform: [0.05, 0.1]}
  outliers: [0, 0.02]
parameters:
  lss.margin: [0.0, 0.5, 1.0]
"""
MANY = str([0.1] * 2000)


@pytest.fixture
def study_of(tmp_path):
    def read(text):
        path = tmp_path / "study.yaml"
        path.write_text(text)
        return read_study(path)

    return read


@pytest.mark.parametrize(
    "text", ["", "a", "1-", "5-3", "1,,2", "-4", "1.5", "0-99999999", "1,1", "5,4-6"]
)
def test_what_is_no_list_of_seeds_is_named(text):
    with pytest.raises(CampaignError):
        parse_seeds(text)


def test_lists_go_together_and_flights_of_a_turn_share_their_seed(study_of):
    study = study_of(VARIED)
    assert study.count == 40 * 2 * 3
    assert study.varied == ("lss.margin", "outliers", "range_noise")
    turn = [study.case(index) for index in range(6)]
    pairs = {(case.labels["outliers"], case.labels["lss.margin"]) for case in turn}
    assert pairs == {(outliers, margin) for outliers in (0, 0.02) for margin in (0.0, 0.5, 1.0)}
    assert len({case.seed for case in turn}) == 1
    assert {case.parameters["lss.margin"] for case in turn} == {0.0, 0.5, 1.0}
    assert study.case(6).seed != turn[0].seed


def test_what_is_drawn_has_its_distribution_and_does_not_hang_on_the_rest(study_of):
    study = study_of(VARIED)
    noise = [study.case(6 * turn).conditions["range_noise"] for turn in range(40)]
    assert all(0.05 <= value <= 0.1 for value in noise)
    assert len(set(noise)) == 40
    assert 0.06 < sum(noise) / 40 < 0.09
    more = study_of(VARIED.replace("duration: 2", "duration: 2\n  dropouts: {uniform: [0, 0.1]}"))
    assert more.case(0).conditions["range_noise"] == noise[0]


def test_the_key_tells_everything_that_decides_a_flight(study_of, tmp_path):
    case = study_of(VARIED).case(3)
    assert key_of(case) == key_of(dataclasses.replace(case, labels={}))
    changes = [{"seed": 1}, {"scenario": "descent"}, {"version": "9"}, {"build": "9"}]
    changes.append({"conditions": {**case.conditions, "duration": 3}})
    changes.append({"parameters": {**case.parameters, "lss.margin": 0.7}})

    def naming(name):
        file = str(tmp_path / name)
        found = [{"parameters": {**case.parameters, f: file}} for f in FILES if "." in f]
        return [{"conditions": {"terrain": file}}, *found]

    for name in ("one", "two"):
        (tmp_path / name).write_text(name)
        changes += naming(name)
    keys = {key_of(dataclasses.replace(case, **change)) for change in ({}, *changes)}
    assert len(keys) == len(changes) + 1
    (tmp_path / "three").write_text("one")  # the content counts, whatever its name
    assert {key_of(dataclasses.replace(case, **change)) for change in naming("three")} <= keys


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("- 1", "mapping"),
        ("flights: 3\nfligths: 4", "fligths"),
        ("scenario: morpheus", "either seeds"),
        ("flights: 3\nseeds: 1-3", "either seeds"),
        ("flights: 0", "flights"),
        ("flights: 3\nseed: -1", "seed"),
        ("flights: 3\nkind: nothing", "unknown kind"),
        ("flights: 3\nkind: nowhere:KIND", "nowhere"),
        ("flights: 3\nkind: ..nowhere:KIND", "cannot be imported"),
        ("flights: 3\nscenario: [morpheus, moon]", "moon"),
        ("flights: 3\nconditions: {wind: 3}", "wind"),
        ("flights: 3\nconditions: {rocks: {uniform: [1, 0]}}", "rocks"),
        ("flights: 3\nconditions: {rocks: {poisson: 3}}", "poisson"),
        ("flights: 3\nconditions: {rocks: []}", "rocks"),
        ("flights: 3\nconditions: {rocks: {log_uniform: [0, 1]}}", "rocks"),
        ("flights: 3\nconditions: {rocks: [0.1, {uniform: [0, 0.1]}]}", "rocks: .* in a list"),
        ("flights: 3\ncases: [{name: a}, {name: a}]", "two cases"),
        ("flights: 9000000", "most"),
        (f"flights: 1\nconditions: {{rocks: {MANY}, duration: {MANY}, outliers: {MANY}}}", "most"),
    ],
)
def test_what_makes_no_sense_is_named_in_one_line(study_of, text, word):
    with pytest.raises(CampaignError, match=word) as caught:
        study_of(text)
    assert "study.yaml" in str(caught.value)
    assert "\n" not in str(caught.value)


STUDIES = sorted((Path(__file__).parents[2] / "studies").glob("*.yaml"))


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_every_study_can_be_flown(path):
    study = read_study(path)
    last = study.case(study.count - 1)
    assert last.index == study.count - 1 and last.parameters
    assert (study.kind is FLY) == path.stem.startswith("flight")
    if study.kind is FLY:
        for index in range(len(study.combinations)):
            settings_of(study.case(index))


def test_the_documents_have_every_study_with_its_flights():
    text = (STUDIES[0].parent / "RESULTS.md").read_text("utf-8")
    told = re.findall(r"\((\w+)\.yaml\) \| ([\d,]+) \|", text)
    flights = {name: int(count.replace(",", "")) for name, count in told}
    assert flights == {path.stem: read_study(path).count for path in STUDIES}


def test_small_flights_find_hazards():
    path = next(path for path in STUDIES if path.stem == "small")
    flown = fly(read_study(path).case(0))
    assert not isinstance(flown, str), flown
    assert flown["hazardous_found"] > 98.0 and flown["safe_found"] > 50.0
    assert flown["unsafe_in_top_five"] == 0


@pytest.mark.slow
@pytest.mark.xdist_group("campaign")
def test_the_small_study_is_flown(tmp_path):
    pytest.importorskip("distributed")
    path = next(path for path in STUDIES if path.stem == "small")
    result = campaign(read_study(path), tmp_path, workers=2)
    assert len(result.records) == 8 and not result.failed
    rules, touchdown = sorted(
        next(line.mean for line in lines if line.quantity.name == "safe_found")
        for _, lines in result.lines
    )
    assert rules < touchdown  # the paper's rules find less safe ground
    assert all(r.figures["unsafe_in_top_five"] == 0 for r in result.records.values())
