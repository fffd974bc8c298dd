# SPDX-License-Identifier: Apache-2.0
"""Scores of results whose answers are known."""

import itertools
import json

import numpy as np
import pytest
from evaluation.scores import ground, write_results, write_truth

from quadtree_lss.lab.evaluation.evaluate import evaluate
from quadtree_lss.lab.evaluation.metrics import fill_holes
from quadtree_lss.lab.evaluation.results import EvaluationError
from quadtree_lss.onboard.errors import QuadtreeLssError


def _evaluate(tmp_path, truth=None, page=False, **results):
    folder = write_results(tmp_path / "results", **results)
    path = write_truth(tmp_path / "truth.npz", **(truth or {}))
    return evaluate(folder, path, page=page)


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


def test_error_is_weighted_by_area(tmp_path):
    # One metre off in the half with the few large leaves.
    truth = {"elevation": lambda x, y: ground(x, y) - np.where(x < 0.0, 1.0, 0.0)}
    error = _evaluate(tmp_path, truth=truth).elevation
    assert error.mean_absolute == pytest.approx(0.5, abs=0.02)
    assert error.rms_mean_removed == pytest.approx(0.5, abs=0.02)


def test_unseen_ground_is_not_scored_for_elevation(tmp_path):
    truth = {"elevation": lambda x, y: ground(x, y) + np.where(x > 0.0, 50.0, 0.0)}
    error = _evaluate(tmp_path, truth=truth, unseen=lambda x, y: x > -0.5).elevation
    assert error.maximum < 1e-6
    assert error.samples < 0.5 * 64**2


def test_cells_with_points_without_an_estimate_are_counted_where_they_are_most(tmp_path):
    """At the border of what was seen, where grid points about them are unseen."""
    shown = {"unseen": lambda x, y: x > 5.0, "observed": lambda x, y: x < 6.0}
    error = _evaluate(tmp_path, **shown, estimated=lambda x, y: x < 5.0).elevation
    assert error.without_estimate == pytest.approx(1.0 / 14.0)
    # Some in the west: a coarse leaf counts by its observed cells.
    error = _evaluate(
        tmp_path,
        observed=lambda x, y: (y > 0.0) & ((x < -6.0) | (x > 4.0)),
        estimated=lambda x, y: x > -6.0,
    ).elevation
    assert error.without_estimate == pytest.approx(1.0 / 3.0)


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


def test_missed_depth_is_that_of_missed_ground(tmp_path):
    """A hazard of 3 m about (3, 0) is found; one of 0.4 m about (-5, 0) is not."""

    def safe(x, y):
        return (np.hypot(x - 3.0, y) > 3.0) & (np.hypot(x + 5.0, y) > 0.4)

    found = _evaluate(tmp_path, truth={"safe": safe}, called_safe=lambda x, y: x < -2.0).detection
    assert found.missed_grid_points > 0
    assert found.missed_depth < 0.8


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


def test_the_elevation_is_within_the_bounds_of_the_leaves(tmp_path):
    low, high = -0.2, 0.1
    free = _evaluate(tmp_path / "free").elevation
    kept = _evaluate(tmp_path / "kept", bounds=(low, high)).elevation
    x, y = np.meshgrid(*[np.linspace(-8.0, 8.0, 401)] * 2)
    expected = np.abs(np.clip(ground(x, y), low, high) - ground(x, y)).mean()
    assert free.maximum < 1e-9
    assert kept.mean_absolute == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(("width", "filled"), [(1.75, True), (2.5, False)])
def test_holes_up_to_two_metres_are_filled(width, filled):
    axis = np.arange(-10.0, 10.1, 0.25)
    seen = np.hypot(*np.meshgrid(axis, axis)) > 0.5 * width
    assert fill_holes(seen, 0.25).all() == filled
    assert (fill_holes(seen, 0.25) >= seen).all()


def test_unsafe_sites_are_counted_among_the_first_five(tmp_path):
    sites = [(-1.0, 0.0), (1.0, 0.0), (-2.0, 0.0), (2.0, 1.0), (3.0, 3.0), (-4.0, 0.0)]
    result = _evaluate(tmp_path, truth={"safe": lambda x, y: x > 0.0}, sites=sites)
    assert result.unsafe_in_top_five == 2
    assert result.sites == 6


@pytest.mark.parametrize(
    ("low", "high", "spacing", "points"), [(-7.9, 7.6, 0.5, 31), (-6.5, 7.0, 0.3, 46)]
)
def test_grid_points_that_do_not_coincide_are_simulated(tmp_path, low, high, spacing, points):
    # A lattice of 0.25 m against a grid shifted off it, or that shares every fifth point alone: the
    # truth's own map is not read.
    truth = {"box": (low, high, low, high), "safe": lambda x, y: x > 99.0}
    result = _evaluate(tmp_path, truth=truth, spacing=spacing).detection
    assert result.safe_found == 1.0
    assert result.safe_grid_points == points**2
    assert np.isnan(result.hazardous_found)


def test_no_site_at_all(tmp_path):
    result = _evaluate(tmp_path, sites=[], called_safe=lambda x, y: x > 99.0)
    assert result.sites == result.unsafe_in_top_five == 0
    assert "0 of 0" in result.table()
    numbers = json.loads((result.out / "evaluation.json").read_text())
    assert numbers["elevation"]["rms"] == result.elevation.rms
    assert numbers["detection"]["hazardous_found"] is numbers["detection"]["precision"] is None


def with_risk(folder, risk):
    """Results that tell a risk; ``risk`` is given x and y."""
    with np.load(folder / "grid.npz") as file:
        arrays = dict(file)
    arrays["risk"] = risk(*np.meshgrid(arrays["x"], arrays["y"]))
    np.savez(folder / "grid.npz", **arrays)


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


@pytest.mark.parametrize("risk", [None, lambda x, y: x * np.nan])
def test_results_without_a_risk_are_scored_without(tmp_path, risk):
    folder = write_results(tmp_path / "results")
    if risk is not None:
        with_risk(folder, risk)
    result = evaluate(folder, write_truth(tmp_path / "truth.npz"), page=False)
    assert result.risk is None
    assert json.loads((result.out / "evaluation.json").read_text())["risk"] is None


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
    with pytest.raises(QuadtreeLssError, match=name) as caught:
        evaluate(folder, truth)
    assert "\n" not in str(caught.value)


def test_numbers_that_do_not_exist_are_dashes(tmp_path):
    folder = write_results(tmp_path / "results", unseen=lambda x, y: x < 99.0, sites=[])
    header = (folder / "timing.csv").read_text().splitlines()[0]
    (folder / "timing.csv").write_text(header + "\n")  # as of a bag of maps
    result = evaluate(folder, write_truth(tmp_path / "truth.npz"), page=False)
    table = result.table()
    assert "nan" not in table
    line = next(line for line in table.splitlines() if "RMS with the mean removed" in line)
    assert line.split()[-1] == "-"


def test_map_somewhere_else(tmp_path):
    folder = write_results(tmp_path / "results")
    truth = write_truth(tmp_path / "truth.npz", box=(9.0, 11.0, 9.0, 12.0))
    with pytest.raises(EvaluationError, match="overlap"):
        evaluate(folder, truth)
    with pytest.raises(EvaluationError, match="a single grid point"):
        evaluate(write_results(tmp_path / "one", spacing=40.0), write_truth(tmp_path / "all.npz"))


def test_site_beyond_the_true_terrain_is_unknown_not_unsafe(tmp_path):
    # The DEM ends at ±12 m; a lander needs 2 m around it.
    sites = [(0.0, 0.0), (9.9, 0.0), (10.1, 0.0), (40.0, 0.0)]
    result = _evaluate(tmp_path, sites=sites)
    assert result.site_verdicts == ("safe", "safe", "unknown", "unknown")
    assert result.unsafe_in_top_five == 0
    assert "rank 3, 4 beyond the true terrain" in result.table()
