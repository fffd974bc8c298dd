# SPDX-License-Identifier: Apache-2.0
"""The documents say what is true: marked blocks run as written, links lead somewhere."""

import importlib
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from replay.recordings import flight as hovering
from replay.recordings import recording
from replay.test_pose_inputs import OdometryRecorder

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.lab.simulation.simulate import simulate
from quadtree_lss.onboard.config.settings import parameters

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = (".", "docs", "docs/tutorials", "docs/reference", "msg_docs", "studies")
PAGES = sorted(path for folder in FOLDERS for path in (ROOT / folder).glob("*.md"))
MARKED = re.compile(
    r"<!-- test: (shell|python)([^>]*)-->\n```\w+\n(.*?)```(?:\n\n```text\n(.*?)```)?", re.DOTALL
)


def blocks(kind):
    """(needs a flight, code, what it prints) of each page's marked blocks; again with slow ones."""
    cases = []
    for page in PAGES:
        found = [m.groups() for m in MARKED.finditer(page.read_text()) if m[1] == kind]
        needs = any("flight/bag" in note for _, note, _, _ in found)
        quick = [(text, shown) for _, note, text, shown in found if "slow" not in note]
        if quick:
            cases.append(pytest.param(needs, quick, id=page.name))
        if len(quick) < len(found):
            every = [(text, shown) for _, _, text, shown in found]
            marks = pytest.mark.slow
            cases.append(pytest.param(needs, every, id=f"{page.name} all", marks=marks))
    return cases


@pytest.fixture(scope="session")
def flight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    simulate("morpheus", folder / "bag", seed=3, duration=1.0)
    return folder


def ran(folder, *command):
    """What a command says that ends well, with the programs of this python."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    how = {"cwd": folder, "env": {**os.environ, "PATH": path}, "capture_output": True}
    done = subprocess.run(command, text=True, **how)
    assert done.returncode == 0, done.stderr
    return done.stdout


def printed(shown, said):
    """Lines that a page shows of what its commands say, in their order; … is left out, and columns
    may be wider."""
    for line in (shown or "").splitlines():
        words = re.sub(r"(\\ )+", " +", re.escape(line)).replace("…", ".*")
        found = re.search(f"^{words}$", said, re.MULTILINE)
        assert found, line
        said = said[found.end() :]


@pytest.mark.slow
@pytest.mark.parametrize(("needs_flight", "code"), blocks("shell"))
def test_commands_run_as_written(needs_flight, code, flight, tmp_path):
    if needs_flight:
        shutil.copytree(flight, tmp_path / "flight")
    shutil.copytree(ROOT / "config", tmp_path / "config")
    command = f"{sys.executable} -m quadtree_lss.cli"
    for text, shown in code:
        script = re.sub(r"^quadtree-lss ", f"{command} ", text, flags=re.MULTILINE)
        printed(shown, ran(tmp_path, "bash", "-ec", script))


class LevelBody(OdometryRecorder):
    """As an autopilot tells a drone that hovers: odometry of a body that is level."""

    odometry = ("/nav/odometry",)

    def pose(self, stamp_ns, position):
        return super().pose(stamp_ns, position, xyzw=(0.0, 0.0, 0.0, 1.0))


@pytest.mark.slow
def test_the_drone_of_the_tutorial_is_checked_and_its_hover_is_replayed(tmp_path):
    """Its file, and the commands that need neither a drone nor `ros2`, as written."""
    page = (ROOT / "docs/tutorials/drone.md").read_text()
    copied, check, _, look = re.findall(r"```sh\n(.*?)```", page, re.DOTALL)
    (added,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    good, _ = re.findall(r"```text\n(.*?)```", page, re.DOTALL)
    with recording(tmp_path / "hover", LevelBody) as recorder:
        hovering(recorder, pose_topics=LevelBody.odometry)

    def run(script):
        script = script.replace("$(ros2 pkg prefix --share quadtree_lss)", str(ROOT))
        script = script.replace("ros2 run quadtree_lss ", "")
        script = re.sub("(?m)^(ros2 bag record|quadtree-lss doctor) .*$", "", script)
        script = script.replace("quadtree-lss ", f"{sys.executable} -m quadtree_lss.cli ")
        return ran(tmp_path, "bash", "-ec", script)

    run(copied)
    file = tmp_path / "drone.yaml"
    values = yaml.safe_load(file.read_text())
    for name, section in yaml.safe_load(added)["/**"]["ros__parameters"].items():
        values["/**"]["ros__parameters"].setdefault(name, {}).update(section)
    file.write_text(yaml.safe_dump(values))
    printed(good, run(check))
    assert "10 scans mapped, 0 dropped" in run(look)


@pytest.mark.slow
@pytest.mark.parametrize(("needs_flight", "code"), blocks("python"))
def test_python_runs_as_written(needs_flight, code, flight, tmp_path):
    if needs_flight:
        shutil.copytree(flight, tmp_path / "flight")
    for text, _ in code:
        assert ran(tmp_path, sys.executable, "-c", text)


def test_the_blocks_above_were_found():
    assert len(blocks("shell")) >= 2 and len(blocks("python")) >= 1


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text()):
        if not target.startswith("http"):
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_are_named_exist(page):
    """`onboard/core/tree/checkpoint.py`, as seen from the repository or the package."""
    for name in re.findall(r"`([\w/]+\.(?:py|pxd|js|css))`", page.read_text()):
        assert any((folder / name).exists() for folder in (ROOT, ROOT / "quadtree_lss")), name


@pytest.mark.parametrize(
    "page", [p for p in PAGES if p.parent.name != "msg_docs"], ids=lambda page: page.name
)
def test_parameters_that_are_named_exist(page):
    names = {row.name for row in parameters()}
    sections = {name.partition(".")[0] for name in names}
    for word in re.findall(r"`([a-z_]+\.[a-z_0-9]+)(?::[^`]*)?`", page.read_text()):
        if word.partition(".")[0] in sections - {"map", "lidar", "diagnostics"}:
            assert word in names, word


def test_functions_that_are_named_exist():
    """`lab.simulation.simulate.simulate(…)`, and what begins with the package."""
    text = "".join(page.read_text() for page in PAGES)
    named = re.findall(r"`(?:quadtree_lss\.)?([a-z_]+(?:\.\w+)+)\(", text)
    named += re.findall(r"`quadtree_lss\.([\w.]+\.\w+)`", text)
    assert len(named) > 10
    for module, _, name in [function.rpartition(".") for function in named]:
        assert hasattr(importlib.import_module(f"quadtree_lss.{module}"), name), (module, name)


def test_pages_that_code_and_configurations_name_exist():
    folders = ("quadtree_lss", "config", "studies", "benchmark", "examples", "launch", "test")
    files = [p for f in folders for kind in ("py", "yaml") for p in (ROOT / f).rglob(f"*.{kind}")]
    named = {n for p in files for n in re.findall(r"\b(?:msg_)?docs/\w+\.md", p.read_text())}
    assert len(named) > 5 and all((ROOT / name).exists() for name in named), named


def test_the_table_of_equations_leads_from_each_to_functions_and_to_code_that_names_it():
    text, found = (ROOT / "studies" / "RESULTS.md").read_text(), set()
    for row in re.findall(r"^\| Eq\..*$", text, re.MULTILINE):
        code = ""
        for file, functions in re.findall(r"`([\w/]+\.py)`((?: `\w+`,?)*)", row):
            top = ROOT if file.startswith("benchmark/") else ROOT / "quadtree_lss"
            source = (top / file).read_text()
            for name in re.findall(r"`(\w+)`", functions):
                assert re.search(rf"(def|class) {name}\b", source), (file, name)
            code += source
        for number in re.findall(r"Eq\. (\d+)", row.split("|")[1]):
            assert re.search(rf"Eq\. {number}\b", code), (number, row)
            found.add(int(number))
    assert found == set(range(1, 64))


def test_every_name_in_the_files_is_documented(flight, tmp_path):
    """Columns, arrays and keys as they are written, each in the section of its file."""
    config = load_config(["morpheus"])
    replay(flight / "bag", tmp_path, config, report=False)
    names = {
        "sites.csv": (tmp_path / "sites.csv").read_text().splitlines()[0].split(","),
        "timing.csv": (tmp_path / "timing.csv").read_text().splitlines()[0].split(","),
        "cells.npz": list(np.load(tmp_path / "cells.npz")),
        "grid.npz": list(np.load(tmp_path / "grid.npz")),
        "history.npz": list(np.load(tmp_path / "history.npz")),
        "summary.json": list(json.loads((tmp_path / "summary.json").read_text())),
        "What a simulation writes": list(np.load(flight / "truth.npz")),
    }
    page = (ROOT / "docs" / "topics_and_files.md").read_text()
    for title, written in names.items():
        section = re.search(rf"^##+ {re.escape(title)}\n(.*?)^##", page, re.DOTALL | re.MULTILINE)
        documented = re.findall(r"`(\w+)`", section[1])
        assert set(written) <= set(documented), (title, set(written) - set(documented))


def test_the_page_of_the_commands_is_up_to_date():
    written = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    remedy = "python docs/commands.py > docs/commands.md"
    assert written == runpy.run_path(str(ROOT / "docs" / "commands.py"))["commands_page"](), remedy


def test_keys_of_the_diagnostics_are_documented():
    nodes = (ROOT / "quadtree_lss" / "onboard" / "nodes").glob("*.py")
    keys = {k for p in nodes for k in re.findall(r'"([a-z_]+\.[a-z_]+)"', p.read_text())}
    page = (ROOT / "msg_docs" / "diagnostics.md").read_text()
    missing = {k for k in keys if f"`{k}`" not in page} - {row.name for row in parameters()}
    assert len(keys) > 15 and not missing, missing


def test_the_rule_of_nan_is_as_documented(flight, tmp_path):
    """docs/topics_and_files.md: measured, inherited and unestimated leaves; unseen nodes."""
    replay(flight / "bag", tmp_path, load_config(["morpheus"]), report=False)
    cells = np.load(tmp_path / "cells.npz")
    measured, known = cells["measured"], np.isfinite(cells["z"])
    assert not (measured & ~known).any()
    inherited = known & ~measured
    assert measured.any() and inherited.any() and not known.all()
    for name in ("nx", "ny", "nz", "covariance"):
        finite = np.isfinite(cells[name]).reshape(len(known), -1)
        np.testing.assert_array_equal(finite.all(axis=1), known)
        np.testing.assert_array_equal(finite.any(axis=1), known)
    for name in ("roughness", "exception_fraction"):
        np.testing.assert_array_equal(np.isfinite(cells[name]), measured)
    np.testing.assert_array_equal(cells["count"] > 0, measured)
    feature = np.isfinite(cells["feature"])
    assert (feature.all(axis=1) == feature.any(axis=1)).all()
    assert feature.any() and not feature[~measured].any()
    grid = np.load(tmp_path / "grid.npz")
    seen = grid["hazard"] & 128 == 0
    np.testing.assert_array_equal(np.isfinite(grid["elevation"]), seen)
    np.testing.assert_array_equal(np.isfinite(grid["slope_deg"]), seen)
    np.testing.assert_array_equal(np.isfinite(grid["score"]), grid["safe"])
    assert not grid["safe"][~seen].any()
