# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss view``: the page of whatever is in a folder."""

import json
import shutil
import webbrowser

import pytest

from quadtree_lss.cli import main


@pytest.fixture
def opened(monkeypatch):
    """What a browser was asked to open."""
    asked = []
    monkeypatch.setattr(webbrowser, "open", lambda address: asked.append(address) or True)
    return asked


@pytest.mark.parametrize(
    ("names", "first"),
    [
        (["campaign.html", "report.html"], "campaign.html"),
        (["flight.html", "report.html"], "flight.html"),
        (["evaluation/report.html"], "evaluation/report.html"),
        (["latest/report.html"], "latest/report.html"),
    ],
)
def test_it_opens_what_the_folder_is_of(names, first, opened, tmp_path, capsys):
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text("")
    assert main(["view", str(tmp_path)]) == 0
    assert opened == [(tmp_path / first).as_uri()]
    assert capsys.readouterr().out.strip() == str(tmp_path / first)


@pytest.mark.slow
def test_of_results_without_a_page_it_is_made(result, text, opened, tmp_path, capsys):
    out = shutil.copytree(result.out, tmp_path / "out")
    shutil.rmtree(out / "figures")
    (out / "report.html").unlink()
    assert main(["view", str(out), "--no-open", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {
        "page": str(out / "report.html"),
        "opened": False,
    }
    assert not opened and (out / "report.html").read_text() == text
