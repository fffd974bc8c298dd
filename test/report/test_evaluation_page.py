# SPDX-License-Identifier: Apache-2.0
"""The page of an evaluation: truth, error and verdicts as layers, places as links."""

import dataclasses

import numpy as np
import pytest
from evaluation.scores import write_truth
from report.pages import Page, accessible, in_a_browser, sheets

from quadtree_lss.desk.exchange.saved import load_results
from quadtree_lss.lab.evaluation.evaluate import evaluate
from quadtree_lss.lab.evaluation.evaluation_page import VERDICTS
from quadtree_lss.lab.evaluation.results import load_truth


@pytest.fixture(scope="module")
def evaluated(result, tmp_path_factory):
    """Scores and page against a truth in which the western half is not safe."""
    folder = tmp_path_factory.mktemp("truth")
    written = load_truth(write_truth(folder / "truth.npz", safe=lambda x, y: x > 0.0))
    truth = dataclasses.replace(
        written, scan_stamp_ns=np.array([row.stamp_ns for row in result.timings])
    )
    arrays = dict(np.load(folder / "truth.npz"))
    count = len(result.timings)
    for name in ("scan_position", "scan_quaternion_xyzw"):
        arrays[name] = np.repeat(arrays[name], count, axis=0)
    np.savez(folder / "truth.npz", **arrays | {"scan_stamp_ns": truth.scan_stamp_ns})
    found = evaluate(result.out, folder / "truth.npz", folder / "out")
    return found, truth, (folder / "out" / "report.html").read_text()


def test_its_layers_are_the_truth_and_what_became_of_it(result, evaluated):
    found, truth, text = evaluated
    page = Page(text)
    layers = {layer["name"]: layer for layer in page.data["layers"]}
    assert list(layers) == ["verdict", "truth", "error"]
    grid = load_results(result.out).grid
    true = truth.elevation_at(*np.meshgrid(grid.x, grid.y)).ravel()
    got = page.column(layers["truth"]["values"])
    np.testing.assert_allclose(got, true, atol=layers["truth"]["values"]["step"])
    error = page.column(layers["error"]["values"])
    assert np.nanmean(error) == pytest.approx(0.0, abs=1e-3)
    expected = np.where(grid.seen.ravel(), grid["elevation"].ravel() - true, np.nan)
    np.testing.assert_allclose(
        error, expected - np.nanmean(expected), atol=layers["error"]["values"]["step"]
    )
    classes = page.column(layers["verdict"]["values"])
    missed = [name for name, _ in VERDICTS].index("hazard, MISSED")
    assert np.count_nonzero(classes == missed) == found.detection.missed_grid_points > 0
    assert text.count('href="#layer=verdict') == len(found.site_verdicts)


@in_a_browser
@pytest.mark.slow
def test_it_can_be_used_by_all_and_prints_on_two_sheets(evaluated, in_browser):
    assert accessible(in_browser, evaluated[2]) and 1 <= sheets(in_browser, evaluated[2]) <= 2
