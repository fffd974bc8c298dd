# SPDX-License-Identifier: Apache-2.0
"""Several runs over one ground, and what the figures are called."""

import json

import numpy as np
import pytest
from evaluation.scores import write_results, write_truth

from quadtree_lss.lab.evaluation.evaluate import compare, evaluate
from quadtree_lss.lab.evaluation.figures import processing_time
from quadtree_lss.lab.evaluation.results import EvaluationError


def test_a_row_for_each_run_and_figures_of_all(tmp_path):
    first = write_results(tmp_path / "ff13")
    second = write_results(tmp_path / "ff14", called_safe=lambda x, y: x > 0.0)
    truth = write_truth(tmp_path / "truth.npz")
    result = compare([first, second], truth, tmp_path / "out")
    assert list(result.runs) == ["ff13", "ff14"]
    assert result.runs["ff13"].detection.safe_found == 1.0
    assert result.runs["ff14"].detection.safe_found < 0.6
    lines = result.table().splitlines()
    assert [row.split()[0] for row in lines[:3]] == ["run", "ff13", "ff14"]
    assert lines[3:] == [
        "ff13, ff14: Table 2: needs --bag",
        "ff13, ff14: report.html: the results lack 'bag'",
    ]
    assert not (second / "evaluation").exists()
    assert {path.name for path in result.figures} == {
        "fig11_processing_time.png",
        "fig25_selected_sites.png",
    }
    assert set(json.loads((tmp_path / "out" / "evaluation.json").read_text())) == set(result.runs)
    assert (tmp_path / "out" / "ff14" / "evaluation.json").is_file()


def test_without_a_place_several_go_into_a_new_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folders = [write_results(tmp_path / name) for name in ("a", "b")]
    truth = write_truth(tmp_path / "truth.npz")
    one = evaluate(folders[1], truth, figures=False)
    before = (one.out / "evaluation.json").read_bytes()
    result = compare(folders, truth, figures=False)
    assert result.out.parent.resolve() == tmp_path / "results"
    assert (one.out / "evaluation.json").read_bytes() == before


def test_runs_of_one_name_cannot_be_told_apart(tmp_path):
    truth = write_truth(tmp_path / "truth.npz")
    folders = [write_results(tmp_path / parent / "results") for parent in "ab"]
    with pytest.raises(EvaluationError, match="results, results"):
        compare(folders, truth, figures=False)


def _numbers(result):
    return {path.name.split("_")[0] for path in result.figures}


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
    assert _numbers(evaluate(folder, truth)) == names


def test_scans_of_the_truth_must_match_one_another(tmp_path):
    folder, truth = write_results(tmp_path / "run"), write_truth(tmp_path / "truth.npz")
    known = dict(np.load(truth))
    known["scan_flight"] = np.zeros(7, int)
    np.savez(truth, **known)
    with pytest.raises(EvaluationError, match="scan_flight has 7 rows"):
        evaluate(folder, truth, figures=False)


def test_scans_are_counted_in_whole_numbers():
    axes = processing_time({"run": np.array([1.0, 2.0, 1.5])}).axes[0]
    ticks = axes.get_xticks()
    np.testing.assert_array_equal(ticks, np.round(ticks))
