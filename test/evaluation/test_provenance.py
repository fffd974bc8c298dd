# SPDX-License-Identifier: Apache-2.0
"""Results and truth of different flights are refused; those of one flight are scored."""

import numpy as np
import pytest
from evaluation.scores import write_results, write_truth

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.lab.evaluation.evaluate import evaluate
from quadtree_lss.lab.evaluation.results import EvaluationError
from quadtree_lss.lab.simulation.simulate import simulate


def test_a_map_for_another_vehicle_than_that_of_the_truth(tmp_path):
    simulate("morpheus", tmp_path / "bag", seed=7, duration=1.0)
    config = load_config(["morpheus"], {"vehicle.max_slope_deg": 5.0})
    replay(tmp_path / "bag", tmp_path / "level", config, report=False)
    (note,) = evaluate(tmp_path / "level", tmp_path / "truth.npz", page=False).notes
    assert "10 deg and 0.3 m of rise" in note and "up to 5 deg and 0.3 m of rise" in note


def test_scans_that_the_truth_does_not_know(tmp_path):
    results, truth = write_results(tmp_path / "results"), write_truth(tmp_path / "truth.npz")
    known = dict(np.load(truth))
    np.savez(truth, **known | {"scan_stamp_ns": np.arange(20)})
    said = "79 of 98 mapped scans are not among its 19, the first at 20 ns"
    with pytest.raises(EvaluationError, match=said) as caught:
        evaluate(results, truth, page=False)
    assert "\n" not in str(caught.value) and not (results / "evaluation").exists()
    np.savez(truth, **known | {"scan_stamp_ns": np.arange(200)})
    evaluate(results, truth, page=False)  # a part of the flight
