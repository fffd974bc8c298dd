# SPDX-License-Identifier: Apache-2.0
"""The page: one file, whose embedded arrays are those of the results folder."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from replay.recordings import GROUND, write_ros2
from report.pages import Page, changed

from quadtree_lss.desk.exchange.saved import load_results
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.desk.report import page_data
from quadtree_lss.desk.report.figures import hazard_figure
from quadtree_lss.desk.report.report import page
from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.landing.hazards import UNSEEN

CONFIG = config_from_values(GROUND)


@pytest.fixture
def content(result):
    return load_results(result.out)


def test_it_is_one_well_formed_file_that_loads_nothing(text):
    found = Page(text)
    program = found.scripts["program"]
    own = program[program.index('"use strict";\nconst root') :]
    assert not re.search(r"https?://|//cdn|\bimport\s|fetch\(|XMLHttpRequest", own)
    for tag, attributes in found.found:
        assert tag not in ("link", "iframe")
        assert not {"src", "href"} & attributes.keys()
    policies = [a["content"] for t, a in found.found if t == "meta" and "http-equiv" in a]
    assert policies and policies[0].startswith("default-src 'none'")
    assert len(text) < 2e6 and len(found.scripts["library-3d"]) < 2e5
    identifiers = [a["id"] for _, a in found.found if "id" in a]
    assert len(set(identifiers)) == len(identifiers)
    for name in re.findall(r'byId\("([a-z0-9-]+)"\)', own):
        assert name in identifiers
    for licence in ("three.js authors", "Leon Sorokin"):
        assert licence in text


def test_the_embedded_arrays_are_those_of_the_grid(result, text):
    found = Page(text)
    data = found.data["grid"]
    with np.load(result.out / "grid.npz") as grid:
        assert (data["ny"], data["nx"]) == grid["score"].shape and data["stride"] == 1
        np.testing.assert_allclose(
            data["xmin"] + np.arange(data["nx"]) * data["spacing"], grid["x"]
        )
        for name, key in (("elevation", "elevation"), ("slope", "slope_deg"), ("score", "score")):
            expected = grid[key].ravel()
            got = found.column(data[name])
            np.testing.assert_array_equal(np.isnan(got), np.isnan(expected))
            np.testing.assert_allclose(got, expected, atol=0.51 * data[name]["step"])
            assert data[name]["step"] < 1e-3 * max(np.nanmax(np.abs(expected)), 1.0)
        np.testing.assert_array_equal(found.column(data["hazard"]), grid["hazard"].ravel())
        np.testing.assert_array_equal(found.column(data["safe"]) > 0, grid["safe"].ravel())


def test_the_embedded_leaves_are_those_of_the_map(result, text):
    found = Page(text)
    data = found.data["leaves"]
    for name in ("level", "ix", "iy", "count"):
        np.testing.assert_array_equal(found.column(data[name]), getattr(result.cells, name))
    np.testing.assert_allclose(found.column(data["z"]), result.cells.z, atol=data["z"]["step"])
    rise = -result.cells.normal[:, 0] / result.cells.normal[:, 2]
    np.testing.assert_allclose(
        found.column(data["slope_x"])[result.cells.measured],
        rise[result.cells.measured],
        atol=data["slope_x"]["step"],
    )


def test_ground_not_yet_mapped_has_a_word_and_a_colour_of_its_own(content):
    """Before what is merely unseen: the first that applies is drawn."""
    names = [kind["name"] for kind in page_data.page_data(content)[0]["hazards"]]
    assert names[:2] == ["observed but not estimated", "unobserved"]

    def words(figure):
        legends = [axes.get_legend() for axes in figure.axes]
        return [text.get_text() for legend in legends for text in legend.get_texts()]

    hazard = content.grid["hazard"].copy()
    hazard[20:30, 20:30] = 192
    figure = hazard_figure(changed(content, grid={**content.grid, "hazard": hazard}))
    assert words(figure).count("observed but not estimated") == 2
    none = changed(content, grid={**content.grid, "hazard": hazard & 63})
    assert "observed but not estimated" not in words(hazard_figure(none))


def test_history_tells_at_what_time_ground_is_seen(result, text, content):
    """Ground may be known in one answer and not in the next; the last is the map as it lies."""
    found = Page(text)
    history = found.data["history"]
    changes = found.column(history["seen"]).reshape(len(history["seconds"]), -1)
    rows = np.unpackbits(np.bitwise_xor.accumulate(changes), axis=1)
    seen = found.column(found.data["grid"]["hazard"]) & UNSEEN == 0
    np.testing.assert_array_equal(rows[-1, : len(seen)], seen)
    every = np.unpackbits(content.history["seen"], axis=1, count=len(seen))
    assert len(np.unique(rows[:, : len(seen)].sum(axis=1))) > 1
    assert {row.tobytes() for row in rows[:, : len(seen)]} <= {row.tobytes() for row in every}
    assert len(history["seconds"]) == len(history["sites"]) > 1
    last = [site[1:3] for site in history["sites"][-1]]
    np.testing.assert_allclose(last, result.assessment.sites.position[:, :2])
    assert len(found.column(history["position"])) == 3 * len(result.timings)


def test_rates_are_those_that_info_tells(result, text):
    assert "10, recorded at 10.00 Hz" in text and "22, recorded at 20.00 Hz" in text
    name = "/".join(Path(result.summary["bag"]).parts[-2:])
    assert f"<h1>Landing sites from {name}</h1>" in text


def test_names_in_a_bag_cannot_become_markup(tmp_path):
    evil = "/points</script><script>alert(1)</script>"
    folder = tmp_path / "<b>bag"
    folder.mkdir()
    bag = write_ros2(folder / "bag", scan_topics=(evil,), scans=3)
    text = (replay(bag, tmp_path / "out", CONFIG).out / "report.html").read_text()
    found = Page(text)
    assert sum(tag == "script" for tag, _ in found.found) == 4
    assert "<b>bag" not in text and "alert(1)</script>" not in text


def test_a_page_can_be_made_again_from_the_folder(content, text):
    assert page(content) == text
    json.loads(Page(page(content)).scripts["data"])
