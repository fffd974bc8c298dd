# SPDX-License-Identifier: Apache-2.0
"""Scores of results whose answers are known."""

import itertools
import json

import numpy as np
import pytest
from evaluation.scores import ground, write_results, write_truth

from quadtree_lss.lab.evaluation.evaluate import evaluate
from quadtree_lss.lab.evaluation.results import EvaluationError


def _evaluate(tmp_path, truth=None, figures=False, **results):
    folder = write_results(tmp_path / "results", **results)
    path = write_truth(tmp_path / "truth.npz", **(truth or {}))
    return evaluate(folder, path, figures=figures)


def test_a_map_that_is_perfect_but_for_a_constant_offset(tmp_path):
    result = _evaluate(tmp_path, offset=-0.3)
    error = result.elevation
    sizes = error.mean_absolute, error.rms, error.maximum, -error.mean
    assert sizes == pytest.approx((0.3,) * 4)
    assert error.rms_mean_removed == pytest.approx(0.0, abs=1e-9)
    assert error.without_estimate == 0.0
    assert result.detection.safe_found == 1.0
    assert np.isnan(result.detection.hazardous_found)
    assert result.unsafe_in_top_five == 0
    assert (result.leaves, result.leaves_estimated) == (544, 544)
    assert result.map_ms_median == 50.0
    assert result.map_s_total == pytest.approx(99 * 50.0 * 1e-3)


def test_error_is_weighted_by_area(tmp_path):
    # One metre off in the half with the few large leaves.
    truth = {"elevation": lambda x, y: ground(x, y) - np.where(x < 0.0, 1.0, 0.0)}
    error = _evaluate(tmp_path, truth=truth).elevation
    assert error.mean_absolute == pytest.approx(0.5, abs=0.02)
    assert error.rms_mean_removed == pytest.approx(0.5, abs=0.02)
    assert error.maximum_mean_removed == pytest.approx(0.5, abs=0.02)


def test_unseen_ground_is_not_scored_for_elevation(tmp_path):
    truth = {"elevation": lambda x, y: ground(x, y) + np.where(x > 0.0, 50.0, 0.0)}
    error = _evaluate(tmp_path, truth=truth, unseen=lambda x, y: x > -0.5).elevation
    assert error.maximum < 1e-6
    assert error.samples < 0.5 * 64**2


def test_detection_rates(tmp_path):
    result = _evaluate(
        tmp_path,
        truth={"safe": lambda x, y: x > 0.0},
        called_safe=lambda x, y: (y > 0.0) | (x < -4.0),
    ).detection
    # Hazardous: 33 columns of which 16 (x < −4) are called safe, of the others y > 0.
    hazardous, safe = 33 * 65, 32 * 65
    missed = 16 * 65 + 17 * 32
    assert result.hazardous_grid_points == hazardous
    assert result.safe_grid_points == safe
    assert result.missed_grid_points == missed
    assert result.hazardous_found == pytest.approx(1.0 - missed / hazardous)
    assert result.safe_found == pytest.approx(32 * 32 / safe)
    assert result.precision == pytest.approx(32 * 32 / (32 * 32 + missed))
    assert result.missed_depth == pytest.approx(8.25)


def test_unknown_counts_as_hazardous_and_is_reported_apart(tmp_path):
    # A hole 1 m wide and 10 m long is filled; the far east is unseen and left out.
    def unseen(x, y):
        return ((np.abs(x + 4.0) < 0.5) & (np.abs(y) < 5.0)) | (x > 4.0)

    result = _evaluate(tmp_path, truth={"safe": lambda x, y: y > 0.0}, unseen=unseen).detection
    columns = 49  # x ≤ 4
    assert result.hazardous_grid_points == columns * 33
    assert result.safe_grid_points == columns * 32
    assert result.hazardous_unknown == pytest.approx(3 * 20 / result.hazardous_grid_points)
    assert result.hazardous_found == pytest.approx(result.hazardous_unknown)
    assert result.safe_unknown == pytest.approx(3 * 19 / result.safe_grid_points)
    assert result.unseen_box == pytest.approx(1.0 - columns / 65)


def test_ground_not_yet_mapped_is_unknown_and_scored(tmp_path):
    """However wide it is: what was seen stays in the score."""
    result = _evaluate(
        tmp_path, truth={"safe": lambda x, y: y > 0.0}, unmapped=lambda x, y: x > 0.0
    )
    found = result.detection
    assert found.unseen_box == 0.0 and found.hazardous_grid_points == 65 * 33
    assert found.safe_unknown == pytest.approx(32 / 65)
    assert found.safe_found == pytest.approx(33 / 65)
    assert found.hazardous_unknown == pytest.approx(32 / 65)


@pytest.mark.slow
def test_no_site_at_all(tmp_path):
    result = _evaluate(tmp_path, sites=[], called_safe=lambda x, y: x > 99.0, figures=True)
    assert result.sites == result.unsafe_in_top_five == 0
    assert "0 of 0" in result.table()
    numbers = json.loads((result.out / "evaluation.json").read_text())
    assert numbers["elevation"]["rms"] == result.elevation.rms
    assert numbers["detection"]["hazardous_found"] is numbers["detection"]["precision"] is None
    for path in result.figures:
        assert path.read_bytes().startswith(b"\x89PNG")


def with_risk(folder, risk):
    """Results that tell a risk; ``risk`` is given x and y."""
    with np.load(folder / "grid.npz") as file:
        arrays = dict(file)
    arrays["risk"] = risk(*np.meshgrid(arrays["x"], arrays["y"]))
    np.savez(folder / "grid.npz", **arrays)


@pytest.mark.slow
def test_risk_is_held_against_the_truth(tmp_path):
    folder = write_results(tmp_path / "results")
    with_risk(folder, lambda x, y: np.where(x < 0.0, 0.02, np.where(y < 0.0, 0.2, 1.0)))
    truth = write_truth(tmp_path / "truth.npz", safe=lambda x, y: (x < 0.0) | (np.abs(x) > 4.0))
    result = evaluate(folder, truth)
    low, high = (b for b in result.risk.bins if b.grid_points)
    assert (low.predicted, low.unsafe) == (pytest.approx(0.02), 0.0)
    assert high.predicted == pytest.approx(0.2) and high.unsafe == pytest.approx(17 / 33)
    assert (low.grid_points, high.grid_points) == (32 * 65, 33 * 32)
    unsafe, points = 17 * 32, result.risk.grid_points
    squares = 32 * 65 * 0.02**2 + (33 * 32 - unsafe) * 0.2**2 + unsafe * 0.8**2
    assert result.risk.brier == pytest.approx(squares / points)
    numbers = json.loads((result.out / "evaluation.json").read_text())
    assert numbers["risk"]["brier"] == result.risk.brier and "Brier" in result.table()
    papers = {f"fig{k}" for k in ("09", 11, 18, 20, 22, 23, 25)}
    assert {path.name.split("_")[0] for path in result.figures} == {"reliability.png", *papers}


ARCHIVES = ("cells.npz", "grid.npz", "truth.npz")


@pytest.mark.parametrize(
    ("name", "content"),
    [
        *itertools.product(
            (*ARCHIVES, "sites.csv", "timing.csv", "summary.json"), (None, b"s\n\xff")
        ),
        *itertools.product(ARCHIVES, (b"", b"PK\x03\x04", "cut", "array")),
    ],
)
def test_a_file_that_cannot_be_read_is_one_clear_line(tmp_path, name, content):
    folder, truth = write_results(tmp_path), write_truth(tmp_path / "truth.npz")
    path = folder / name
    whole = path.read_bytes()
    path.unlink()
    if content == "array":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    elif content is not None:
        path.write_bytes(whole[: len(whole) // 2] if content == "cut" else content)
    with pytest.raises(EvaluationError, match=name) as caught:
        evaluate(folder, truth)
    assert "\n" not in str(caught.value)


def test_missed_places_are_listed_with_what_stands_there(tmp_path):
    def rocks(x, y):
        near = np.hypot(x - 3.0, y + 2.0) < 0.3
        return ground(x, y) + np.where(near, 0.8, 0.0)

    def safe(x, y):
        return (np.hypot(x - 3.0, y + 2.0) > 1.1) & (np.hypot(x + 6.0, y - 6.0) > 0.3)

    result = _evaluate(tmp_path, truth={"elevation": rocks, "safe": safe})
    first, second = result.missed
    assert (first.x, first.y) == pytest.approx((3.0, -2.0), abs=0.01)
    assert (second.x, second.y) == pytest.approx((-6.0, 6.0), abs=0.01)
    assert first.grid_points + second.grid_points == result.detection.missed_grid_points
    assert first.depth == result.detection.missed_depth
    assert first.relief == pytest.approx(0.8, abs=0.15)
