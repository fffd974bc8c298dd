# SPDX-License-Identifier: Apache-2.0
"""Several runs over one ground; and what the figures of a run are called, and of what they are."""

import numpy as np
import pytest
from evaluation.scores import write_results, write_truth

from quadtree_lss.lab.evaluation.evaluate import evaluate
from quadtree_lss.lab.evaluation.results import EvaluationError


def test_fixed_resolution_and_two_flights_have_figures_of_their_own(tmp_path):
    folder, truth = write_results(tmp_path / "run"), write_truth(tmp_path / "truth.npz")
    cells = dict(np.load(folder / "cells.npz"))
    keep = cells["level"] == 5
    cells = {k: v[keep] if len(v.shape) and len(v) == len(keep) else v for k, v in cells.items()}
    cells["domain"] = np.array([-8.0, -8.0, 16.0, 5, 5])
    np.savez(folder / "cells.npz", **cells)
    known = dict(np.load(truth))
    known["scan_stamp_ns"], known["scan_flight"] = np.arange(99), np.repeat([0, 1], [50, 49])
    square = np.array([[-4.0, -4.0], [4.0, -4.0], [4.0, 4.0], [-4.0, 4.0]])
    known["scan_outline"] = np.tile(square, (99, 1, 1))
    np.savez(truth, **known)
    names = {f"fig{k}" for k in (10, 11, 13, 18, 19, 20, 21, 22, 24, 25)}
    assert {path.name.split("_")[0] for path in evaluate(folder, truth).figures} == names


def test_scans_of_the_truth_must_match_one_another(tmp_path):
    folder, truth = write_results(tmp_path / "run"), write_truth(tmp_path / "truth.npz")
    known = dict(np.load(truth))
    known["scan_flight"] = np.zeros(7, int)
    np.savez(truth, **known)
    with pytest.raises(EvaluationError, match=r"scan_flight has shape \(7,\), expected \(1,\)"):
        evaluate(folder, truth, figures=False)
