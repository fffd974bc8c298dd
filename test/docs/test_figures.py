# SPDX-License-Identifier: Apache-2.0
"""Tables and pictures of measurements are of the present defaults, or say that they are not."""

import argparse
import re
import runpy
import shlex
import sys
from pathlib import Path
from unittest import mock

import pytest

from quadtree_lss.lab.campaign.study import read_study

ROOT = Path(__file__).resolve().parents[2]
FIGURES = runpy.run_path(str(ROOT / "docs" / "figures.py"))
ALL = list(FIGURES["figures"]())
parameters_hash = FIGURES["parameters_hash"]


@pytest.mark.parametrize("figure", ALL, ids=lambda figure: figure.command)
def test_a_figure_is_of_the_present_defaults_or_says_so(figure):
    if figure.hash is None:
        assert "earlier build" in figure.body.lower(), "the reader has to see that"
    else:
        remedy = "make it again, or mark it as of an earlier build"
        assert figure.hash == parameters_hash(figure.config, figure.names), remedy


class Parsed(Exception):
    """All options of a command are read."""


@pytest.mark.parametrize("command", sorted({figure.command for figure in ALL}))
def test_the_options_of_a_command_are_known_to_its_script(command, monkeypatch):
    """The script runs until its options are read."""
    program, script, *options = shlex.split(command)
    assert program == "python"
    if script == "benchmark/study.py":
        quantities = {quantity.name for quantity in read_study(ROOT / options[0]).kind.quantities}
        assert quantities.issuperset(options[1:])
    if script in ("benchmark/live.py", "benchmark/arducopter.py", "benchmark/px4.py"):
        pytest.importorskip("rclpy")
    parse = argparse.ArgumentParser.parse_args

    def parse_only(self, args=None, namespace=None):
        parse(self, args, namespace)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    monkeypatch.setattr(sys, "argv", [script, *options])
    monkeypatch.setattr(sys, "path", list(sys.path))
    with mock.patch.dict(sys.modules), pytest.raises(Parsed):
        runpy.run_path(str(ROOT / script), run_name="__main__")


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


@pytest.mark.parametrize("name", ["docs/evidence.md", "studies/RESULTS.md"])
def test_every_figure_of_a_page_is_read(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    assert text.count("<!-- figure:") == sum(figure.page == ROOT / name for figure in ALL) > 0


def test_the_evidence_has_no_table_or_picture_without_its_command():
    text = (ROOT / "docs" / "evidence.md").read_text(encoding="utf-8")
    assert not re.search(r"^\||\]\(images/", FIGURES["FIGURE"].sub("", text), re.MULTILINE)


def test_no_table_of_numbers_is_without_its_command():
    """At least half of its cells are numbers. The seeds of studies/RESULTS.md are not measured."""
    pages = [p for pattern in FIGURES["PAGES"] for p in ROOT.glob(pattern)]
    for page in [p for p in pages if not any(f.is_symlink() for f in (p, *p.parents))]:
        rest = FIGURES["FIGURE"].sub(
            "", page.read_text(encoding="utf-8").partition("\n## Seeds")[0]
        )
        for table in re.findall(r"^\|.*\n\| ---.*\n((?:\|.*\n?)+)", rest, re.MULTILINE):
            cells = [c.strip(" *") for row in table.splitlines() for c in row.split("|")[2:-1]]
            numbers = [c for c in cells if re.fullmatch(r"[-–\d.,% ()]*\d[-–\d.,% ()]*", c)]
            assert 2 * len(numbers) < len(cells) or "studies/" in table, (page.name, table)


def test_every_picture_is_shown():
    pages = [page for pattern in FIGURES["PAGES"] for page in ROOT.glob(pattern)]
    shown = "".join(page.read_text(encoding="utf-8") for page in pages)
    for picture in (ROOT / "docs" / "images").iterdir():
        assert f"images/{picture.name}" in shown, picture.name
