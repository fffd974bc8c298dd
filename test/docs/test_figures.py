# SPDX-License-Identifier: Apache-2.0
"""Tables and pictures of measurements are of the present defaults, or say that they are not."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FIGURES = runpy.run_path(str(ROOT / "docs" / "figures.py"))
ALL = list(FIGURES["figures"]())
parameters_hash = FIGURES["parameters_hash"]


@pytest.mark.parametrize("figure", ALL, ids=lambda figure: figure.command)
def test_a_figure_is_of_the_present_defaults_or_says_so(figure):
    if figure.hash is None:
        assert "earlier build" in figure.body.lower(), "the reader has to see that"
    else:
        remedy = "docs/figures.py makes it again, or with --earlier says so"
        assert figure.hash == parameters_hash(figure.config, figure.names), remedy


def test_a_changed_default_is_seen(tmp_path, monkeypatch):
    """In the configuration, of a name that matches; not of another one."""
    hashed = parameters_hash.__globals__
    (tmp_path / "config").mkdir()
    changed = tmp_path / "config" / "parabola.yaml"
    text = (ROOT / "config" / "parabola.yaml").read_text()
    before = [parameters_hash("parabola", names) for names in ("lidar.* mapping.*", "pose.*")]
    monkeypatch.setitem(hashed, "ROOT", tmp_path)
    changed.write_text(re.sub(r"range_noise: [\d.]+", "range_noise: 0.123", text))
    after = [parameters_hash("parabola", names) for names in ("lidar.* mapping.*", "pose.*")]
    assert after[0] != before[0] and after[1] == before[1]


@pytest.mark.parametrize("page", ["evidence.md", "gallery.md"])
def test_every_measured_table_and_picture_is_a_figure(page):
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    assert text.count("<!-- figure:") == sum(figure.page.name == page for figure in ALL)
    rest = FIGURES["FIGURE"].sub("", text)
    tables = [t for t in re.findall(r"^\|.*\n\| ---", rest, re.MULTILINE) if "Scenario" not in t]
    assert not tables and not re.search(r"\]\(images/\w+\.png\)", rest)


def test_no_table_of_numbers_is_without_its_command():
    """On any page: half of its cells, or more, are numbers. What evidence lists is seeds."""
    pages = [p for p in FIGURES["ROOT"].glob("docs/**/*.md") if p.name != "evidence.md"]
    for page in [p for p in pages if not any(f.is_symlink() for f in (p, *p.parents))]:
        rest = FIGURES["FIGURE"].sub("", page.read_text(encoding="utf-8"))
        for table in re.findall(r"^\|.*\n\| ---.*\n((?:\|.*\n?)+)", rest, re.MULTILINE):
            cells = [c.strip(" *") for row in table.splitlines() for c in row.split("|")[2:-1]]
            numbers = [c for c in cells if re.fullmatch(r"[-–\d.,% ()]*\d[-–\d.,% ()]*", c)]
            assert 2 * len(numbers) < len(cells) or "studies/" in table, (page.name, table)


def test_every_picture_names_its_command():
    """Somewhere among the figures; axes.svg is drawn by hand."""
    shown = "".join(figure.body for figure in ALL)
    for picture in (ROOT / "docs" / "images").glob("*.png"):
        assert f"images/{picture.name}" in shown, picture.name
