# SPDX-License-Identifier: Apache-2.0
"""Results and truth of different flights are refused; those of one flight are scored."""

import json
import shutil

import numpy as np
import pytest
from evaluation.scores import write_results, write_truth

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.lab.evaluation.evaluate import evaluate
from quadtree_lss.lab.evaluation.results import EvaluationError
from quadtree_lss.lab.simulation.simulate import simulate

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
    return tmp_path


def tell(results, **entries):
    path = results / "summary.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **entries}))


def name_truth(path, **entries):
    known = dict(np.load(path))
    np.savez(path, **{**known, **entries})


def score(results, truth, **options):
    return evaluate(results, truth, page=False, **options)


def refused(results, truth, word, **options):
    with pytest.raises(EvaluationError, match=word) as caught:
        score(results, truth, **options)
    assert "\n" not in str(caught.value)
    assert not (results / "evaluation").exists()


def test_a_map_for_another_vehicle_than_that_of_the_truth(both):
    place = both / "7"
    config = load_config(["morpheus"], {"vehicle.max_slope_deg": 5.0})
    replay(place / "bag", place / "level", config, report=False)
    (note,) = score(place / "level", place / "truth.npz").notes
    assert "10 deg and 0.3 m of rise" in note and "up to 5 deg and 0.3 m of rise" in note


def test_scans_that_the_truth_does_not_know(tmp_path):
    results = write_results(tmp_path / "results")
    truth = write_truth(tmp_path / "truth.npz")
    name_truth(truth, scan_stamp_ns=np.arange(20), scan_position=np.zeros((20, 3)))
    refused(results, truth, "79 of 98 mapped scans are not among its 19, the first at 20 ns")
    name_truth(truth, scan_stamp_ns=np.arange(200), scan_position=np.zeros((200, 3)))
    score(results, truth)  # a part of the flight


def test_truth_of_another_seed_with_the_same_stamps(both):
    results, other = both / "7" / "out", both / "8" / "truth.npz"
    tell(results, seed=7)
    refused(results, other, "is of seed 8, but .* of seed 7")
