# SPDX-License-Identifier: Apache-2.0
"""The studies of the repository can be flown, and the small one is."""

from pathlib import Path

import pytest

from quadtree_lss.lab.campaign.engine import Where, campaign, fly
from quadtree_lss.lab.campaign.landings import FLY, settings_of
from quadtree_lss.lab.campaign.study import read_study

STUDIES = sorted((Path(__file__).parents[2] / "studies").glob("*.yaml"))


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_every_study_can_be_flown(path):
    study = read_study(path)
    last = study.case(study.count - 1)
    assert last.index == study.count - 1 and last.parameters
    assert (study.what is FLY) == path.stem.startswith("flight")
    if path.stem == "flight_physics":
        pytest.importorskip("mujoco")
    if study.what is FLY:
        for index in range(len(study.combinations)):
            settings_of(study.case(index))


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
    result = campaign(read_study(path), tmp_path, Where(workers=2))
    assert len(result.records) == 8 and not result.failed
    rules, touchdown = sorted(
        next(line.mean for line in lines if line.quantity.name == "safe_found")
        for _, lines in result.lines
    )
    assert rules < touchdown  # the paper's rules find less safe ground
    assert all(r.figures["unsafe_in_top_five"] == 0 for r in result.records.values())
