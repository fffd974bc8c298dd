# SPDX-License-Identifier: Apache-2.0
"""Results, truth and bag of different flights are told; of one flight they are taken."""

import json
import shutil

import numpy as np
import pytest

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.lab.evaluation.evaluate import evaluate
from quadtree_lss.lab.evaluation.results import EvaluationError
from quadtree_lss.lab.simulation.simulate import simulate

pytestmark = pytest.mark.xdist_group("provenance")  # its flight is made once

SEEDS = (7, 8)


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """Two flights with the same stamps over other ground: folder/<seed>/{bag, truth.npz, out}."""
    folder = tmp_path_factory.mktemp("flights")
    config = load_config(["morpheus"])
    for seed in SEEDS:
        place = folder / str(seed)
        simulate("morpheus", place / "bag", seed=seed, duration=1.0)
        replay(place / "bag", place / "out", config, report=False)
        tell(place / "out", bag=str((place / "bag").resolve()))
    return folder


@pytest.fixture
def both(flights, tmp_path):
    """A copy of the flights to spoil; the bags that results name lie in it."""
    for seed in SEEDS:
        place = tmp_path / str(seed)
        shutil.copytree(flights / str(seed), place)
        tell(place / "out", bag=str(place / "bag"))
        name_truth(place / "truth.npz", bag_name="bag")
    return tmp_path


def tell(results, **entries):
    path = results / "summary.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **entries}))


def name_truth(path, **entries):
    known = dict(np.load(path))
    np.savez(path, **{**known, **entries})


def score(results, truth, **options):
    return evaluate(results, truth, figures=False, **options)


def refused(results, truth, word, **options):
    with pytest.raises(EvaluationError, match=word) as caught:
        score(results, truth, **options)
    assert "\n" not in str(caught.value)
    assert not (results / "evaluation").exists()


def test_own_truth_and_own_bag_are_taken(both):
    result = score(both / "7" / "out", both / "7" / "truth.npz")
    assert result.notes == () and result.consistency is not None
    assert result.consistency.scans == 20
    given = score(both / "7" / "out", both / "7" / "truth.npz", bag=both / "7" / "bag")
    assert given.consistency == result.consistency


def test_a_map_for_another_vehicle_than_that_of_the_truth(both):
    place = both / "7"
    config = load_config(["morpheus"], {"vehicle.max_slope_deg": 5.0})
    replay(place / "bag", place / "level", config, report=False)
    (note,) = score(place / "level", place / "truth.npz", consistency=False).notes
    assert "10 deg and 0.3 m of rise" in note and "up to 5 deg and 0.3 m of rise" in note


def test_truth_of_another_seed_with_the_same_stamps(both):
    results, other = both / "7" / "out", both / "8" / "truth.npz"
    (note,) = score(results, other, consistency=False).notes
    assert str(both / "8" / "bag") in note and str(both / "7" / "bag") in note
    shutil.rmtree(results / "evaluation")
    tell(results, seed=7)
    name_truth(other, seed=8)
    refused(results, other, "is of seed 8, but .* of seed 7")


def test_a_bag_of_another_flight(both):
    results, truth = both / "7" / "out", both / "7" / "truth.npz"
    name_truth(truth, bag_name="unknown")  # so that the results have to tell
    refused(results, truth, "holds other scans than were mapped", bag=both / "8" / "bag")
    table = (results / "timing.csv").read_text().splitlines()
    extra = table[-1].replace(table[-1].split(",")[0], "1700000009000000000")
    (results / "timing.csv").write_text("\n".join([*table, extra]) + "\n")
    known = dict(np.load(truth))
    stamps = np.append(known["scan_stamp_ns"], 1700000009000000000)
    more = {name: known[name][[*range(20), 19]] for name in known if name.startswith("scan_")}
    np.savez(truth, **{**known, **more, "scan_stamp_ns": stamps})
    refused(results, truth, "lacks 1 of the 21 scans", bag=both / "7" / "bag")
