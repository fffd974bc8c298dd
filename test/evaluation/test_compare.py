# SPDX-License-Identifier: Apache-2.0
"""Several runs over one ground."""

import json

import pytest
from evaluation.scores import write_results, write_truth

from quadtree_lss.lab.evaluation.evaluate import compare, evaluate
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
