# SPDX-License-Identifier: Apache-2.0
"""The page: one file, whose embedded arrays are those of grid.npz; drawn by a real browser."""

import base64
import dataclasses
import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from replay.recordings import GROUND, write_ros2

from quadtree_lss.config.settings import config_from_values
from quadtree_lss.replay.replay import replay
from quadtree_lss.report import figures, page_data

CONFIG = config_from_values(GROUND)
BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run"
    " --disable-background-networking --disable-component-update --disable-sync"
    " --virtual-time-budget=5000 --window-size=1200,1000"
).split()


class Page(HTMLParser):
    """Elements, attributes and the content of scripts."""

    VOID = {"meta", "input", "br", "img", "link"}

    def __init__(self, text):
        super().__init__()
        self.found, self.open, self.scripts = [], [], {}
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, text):
        if self.open and self.open[-1][0] == "script":
            self.scripts[self.open[-1][1].get("id", "program")] = text


@pytest.fixture(scope="module")
def result(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return replay(write_ros2(folder / "bag"), folder / "out", CONFIG)


@pytest.fixture(scope="module")
def text(result):
    return (result.out / "report.html").read_text()


def column(packed):
    raw = np.frombuffer(base64.b64decode(packed["data"]), dtype=f"<{packed['kind']}")
    if "step" not in packed:
        return raw
    none = np.iinfo(raw.dtype).max
    return np.where(raw == none, np.nan, packed["low"] + packed["step"] * raw)


def test_it_is_one_well_formed_file_that_loads_nothing(text):
    page = Page(text)
    assert not re.search(r"https?://|//cdn|\bimport\s|fetch\(|XMLHttpRequest", text)
    for tag, attributes in page.found:
        assert tag not in ("link", "iframe", "img")
        assert not {"src", "href"} & attributes.keys()
    policies = [a["content"] for t, a in page.found if t == "meta" and "http-equiv" in a]
    assert policies and policies[0].startswith("default-src 'none'")
    assert len(text) < 5e6
    identifiers = [a["id"] for _, a in page.found if "id" in a]
    assert len(set(identifiers)) == len(identifiers)
    for name in re.findall(r'byId\("([a-z-]+)"\)', page.scripts["program"]):
        assert name in identifiers


def test_the_embedded_arrays_are_those_of_the_grid(result, text):
    data = json.loads(Page(text).scripts["data"])["grid"]
    with np.load(result.out / "grid.npz") as grid:
        assert (data["ny"], data["nx"]) == grid["score"].shape and data["stride"] == 1
        np.testing.assert_allclose(
            data["xmin"] + np.arange(data["nx"]) * data["spacing"], grid["x"]
        )
        for name, key in (("elevation", "elevation"), ("slope", "slope_deg"), ("score", "score")):
            expected = grid[key].ravel()
            got = column(data[name])
            np.testing.assert_array_equal(np.isnan(got), np.isnan(expected))
            np.testing.assert_allclose(got, expected, atol=0.51 * data[name]["step"])
            assert data[name]["step"] < 1e-3 * max(np.nanmax(np.abs(expected)), 1.0)
        np.testing.assert_array_equal(column(data["hazard"]), grid["hazard"].ravel())
        np.testing.assert_array_equal(column(data["safe"]) > 0, grid["safe"].ravel())


def test_the_embedded_leaves_are_those_of_the_map(result, text):
    data = json.loads(Page(text).scripts["data"])["leaves"]
    for name in ("level", "ix", "iy", "count"):
        np.testing.assert_array_equal(column(data[name]), getattr(result.cells, name))
    np.testing.assert_allclose(column(data["z"]), result.cells.z, atol=data["z"]["step"])


def test_roughness_is_shown_by_area_whatever_the_size_of_the_leaf(result):
    """A map whose leaves lie 7 mm off their planes in the mean, large ones and small ones."""
    cells = result.cells
    even = dataclasses.replace(cells, roughness=0.007 * cells.size**2)
    data = page_data.page_data(dataclasses.replace(result, cells=even), CONFIG)["leaves"]
    np.testing.assert_allclose(column(data["roughness"]), 0.007)


def test_large_maps_stay_small_pages(result, monkeypatch):
    monkeypatch.setattr(page_data, "MAX_GRID_POINTS", 500)
    monkeypatch.setattr(page_data, "MAX_LEAVES", 10)
    data = page_data.page_data(result, CONFIG)
    grid = data["grid"]
    assert grid["nx"] * grid["ny"] <= 600 and grid["stride"] > 1
    assert grid["spacing"] == pytest.approx(grid["stride"] * CONFIG.lss.grid_spacing)
    expected = result.assessment.hazard[:: grid["stride"], :: grid["stride"]]
    np.testing.assert_array_equal(column(grid["hazard"]), expected.ravel())
    assert "sigma" not in data["leaves"] and "level" in data["leaves"]


def test_rates_are_those_that_info_tells(result, text):
    assert "10, recorded at 10.00 Hz" in text and "22, recorded at 20.00 Hz" in text
    name = "/".join(Path(result.summary["bag"]).parts[-2:])
    assert f"<h1>Landing sites from {name}</h1>" in text


def test_each_colour_of_a_class_means_one_thing():
    kinds = [colour for _, _, colour in figures.HAZARDS]
    other = [figures.CLEAR_COLOUR, figures.SAFE_COLOUR, figures.EXCLUDED_COLOUR]
    assert len({*kinds, *other, figures.SITE_COLOUR}) == len(kinds) + 4


def test_names_in_a_bag_cannot_become_markup(tmp_path):
    evil = "/points</script><script>alert(1)</script>"
    folder = tmp_path / "<b>bag"
    folder.mkdir()
    bag = write_ros2(folder / "bag", scan_topics=(evil,), scans=3)
    page = Page((replay(bag, tmp_path / "out", CONFIG).out / "report.html").read_text())
    assert sum(tag == "script" for tag, _ in page.found) == 2
    assert not any(tag == "b" and not a for tag, a in page.found[:8])


def in_browser(result, tmp_path, steps):
    """Document after ``steps`` have acted on the page as a person would."""
    assert BROWSER is not None
    text = (result.out / "report.html").read_text()
    path = tmp_path / "page.html"
    path.write_text(text.replace("</body>", f"<script>{steps}</script></body>"))
    command = [BROWSER, *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom"]
    done = subprocess.run([*command, path.as_uri()], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert 'data-ready="yes"' in done.stdout and "data-error" not in done.stdout
    return done.stdout


HELPERS = """
const tellTest = (name, value) => { document.documentElement.dataset[name] = value; };
const at = (type, x, y, more = {}) => map.dispatchEvent(new PointerEvent(type, {
  clientX: map.getBoundingClientRect().left + x, clientY: map.getBoundingClientRect().top + y,
  pointerId: 1, bubbles: true, ...more }));
const shown = () => Object.fromEntries([...document.querySelectorAll("#values tr")].map(
  r => [r.children[0].textContent, r.children[1].textContent]));
const colourAt = (x, y) => { const r = window.devicePixelRatio || 1;
  return [...map.getContext("2d").getImageData(x * r, y * r, 1, 1).data].slice(0, 3).join(); };
"""


@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this computer")
def test_a_browser_draws_it_and_tells_values(result, tmp_path):
    x, y, _ = result.assessment.sites.position[0]
    here = result.assessment.y == y, result.assessment.x == x
    (z,) = result.assessment.elevation[np.ix_(*here)].ravel()
    steps = f"""{HELPERS}
    at("pointermove", px({x}), py({y}));
    tellTest("values", JSON.stringify(shown()));
    const colours = new Set();
    for (const box of document.querySelectorAll("input[name=layer]")) {{
      box.click(); colours.add(colourAt(px({x}) + 14, py({y}) + 14));
    }}
    tellTest("layers", document.querySelectorAll("input[name=layer]").length);
    tellTest("colours", colours.size);
    const legends = {{}};
    for (const name of ["hazards", "score", "cells"]) {{
      view.layer = name; legend();
      legends[name] = [byId("legend").textContent, LAYERS[name].limits && ticks(LAYERS[name])];
    }}
    tellTest("legends", JSON.stringify(legends));
    document.querySelector("#show-relief").click();
    document.querySelector("tr[data-site]").click();
    tellTest("centre", JSON.stringify([view.x, view.y]));
    const before = view.scale;
    map.dispatchEvent(new WheelEvent("wheel", {{ deltaY: -200, clientX: 400, clientY: 400 }}));
    tellTest("zoomed", view.scale > before);
    const place = view.x;
    at("pointerdown", 300, 300); at("pointermove", 340, 300); at("pointerup", 340, 300);
    tellTest("dragged", Math.abs((place - view.x) * view.scale - 40) < 1);
    document.querySelector("#filter").value = "lss.margin";
    document.querySelector("#filter").dispatchEvent(new Event("input"));
    tellTest("rows", document.querySelectorAll("#configuration tbody tr:not([hidden])").length);
    """
    dom = in_browser(result, tmp_path, steps)

    def told(name):
        (value,) = re.findall(f'<html[^>]* data-{name}="([^"]*)"', dom)
        return json.loads(value.replace("&quot;", '"'))

    values = told("values")
    assert float(values["elevation"].split()[0]) == pytest.approx(z, abs=0.02)
    assert values["hazard"] == "none" and values["landing"] == "allowed"
    assert float(values["score"]) == pytest.approx(result.assessment.sites.score[0], abs=2e-4)
    assert values["leaf"].endswith(tuple(f"level {level}" for level in range(3, 7)))
    assert told("layers") == 8 and told("colours") >= 4
    legends = told("legends")
    assert "slope and elevation of leaves do not exclude" in legends["hazards"][0]
    assert "excluded" in legends["score"][0] and len(legends["score"][1]) > 2
    assert legends["cells"][1] == [-1, 0, 1, 2]  # binary logarithms of 0.5 m to 4 m
    np.testing.assert_allclose(told("centre"), [x, y])
    assert told("zoomed") is True and told("dragged") is True
    assert told("rows") == 1


@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this computer")
def test_the_whole_map_stays_whole_in_a_narrower_window(result, tmp_path):
    steps = f"""{HELPERS}
    const inside = () => px(extent.x0) >= MARGIN.left && px(extent.x1) <= width();
    byId("map").style.width = "300px"; window.dispatchEvent(new Event("resize"));
    const whole = inside();
    zoom(2); const scale = view.scale; window.dispatchEvent(new Event("resize"));
    tellTest("whole", JSON.stringify([whole, scale === view.scale]));
    """
    dom = in_browser(result, tmp_path, steps)
    assert 'data-whole="[true,true]"' in dom


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium on this computer")
def test_a_browser_draws_a_map_without_sites(tmp_path):
    config = config_from_values({"lss.max_gap": 0.0}, CONFIG)
    result = replay(write_ros2(tmp_path / "bag", scans=3), tmp_path / "out", config)
    assert "No safe site" in in_browser(result, tmp_path, "draw()")


def test_figures_lie_beside_it(result):
    names = {path.name for path in Path(result.out / "figures").iterdir()}
    assert names == {"elevation.png", "slope.png", "hazards.png", "score.png", "timing.png"}
