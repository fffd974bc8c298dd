# SPDX-License-Identifier: Apache-2.0
"""Flights and studies that physics judges beside the contact; without the engine one line."""

import json
import sys

import numpy as np
import pytest
from report.pages import Page, in_a_browser
from scipy.spatial.transform import Rotation

from quadtree_lss.cli import main
from quadtree_lss.lab.campaign.kinds import Case
from quadtree_lss.lab.campaign.landings import FLY, settings_of
from quadtree_lss.lab.flight.flight_page import write_flight
from quadtree_lss.lab.flight.fly import flown
from quadtree_lss.lab.flight.settings import flight_settings
from quadtree_lss.lab.touchdown.legs import LANDER
from quadtree_lss.onboard.errors import QuadtreeLssError

SHORT = {"avoidance": "perfect", "slant_range": 260.0, "speed": 26.0, "half": 8.0}


def test_a_flight_is_judged_on_legs_as_well():
    pytest.importorskip("mujoco")
    done = flown(3, flight_settings({**SHORT, "judge": "physics"}))
    found, bare = done.flight.landed, flown(3, flight_settings(SHORT)).figures
    assert found.outcome == done.figures["physics"] == "stands" and done.figures["safe"]
    assert {k: v for k, v in done.figures.items() if not k.startswith("physics")} == bare
    assert 0.0 < found.stroke < 0.25 and found.film[0, 3] == pytest.approx(bare["z"], abs=0.3)
    assert found.film[0, 1:3] == pytest.approx([bare["x"], bare["y"]])


def test_a_study_counts_those_that_do_not_stand():
    pytest.importorskip("mujoco")
    conditions = {"judge": "physics", "slant_range": 260.0, "speed": 26.0}
    case = Case(0, "fly", "none", 3, conditions=conditions)
    assert settings_of(case).judge == "physics"
    figures = FLY.fly(case)
    assert figures["judged"] == 1 and figures["physics_fails"] in (0, 1)
    assert {q.name for q in FLY.quantities} <= figures.keys()


def test_without_the_engine_nothing_is_flown_and_one_line_names_it(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(QuadtreeLssError, match="extra 'physics'"):
        flight_settings({"judge": "physics"})
    out = ["--out", str(tmp_path / "none"), "--no-page"]
    assert main(["fly", "--lockstep", "--avoidance", "none", "--physics", *out]) == 1
    said = capsys.readouterr().err.strip()
    assert "physics" in said and "\n" not in said


def test_the_command_says_what_became_of_it_on_legs(tmp_path, capsys):
    pytest.importorskip("mujoco")
    out = ["--out", str(tmp_path), "--no-page"]
    assert main(["fly", "--lockstep", "--avoidance", "none", "--seed", "3", "--physics", *out]) == 0
    figures = json.loads((tmp_path / "touchdown.json").read_text())
    assert f"on its legs: {figures['physics']}\n" in capsys.readouterr().out


@pytest.fixture(scope="module")
def landed(tmp_path_factory):
    """A flight that comes down on its legs, and its page."""
    pytest.importorskip("mujoco")
    out = tmp_path_factory.mktemp("landed")
    small = {"config": {"domain.size": 16.0}}
    done = flown(3, flight_settings({**SHORT, **small, "judge": "physics"}))
    write_flight(out, done)
    return done, (out / "flight.html").read_text()


def test_the_page_goes_on_until_it_rests(landed):
    done, text = landed
    page, film = Page(text), done.flight.landed.film
    flight, first = page.data["flight"], len(done.flight.samples)
    assert flight["film"]["first"] == first and "on its legs: stands" in text
    time, z = (page.column(flight[name])[first:] for name in ("time", "z"))
    np.testing.assert_allclose(time, done.flight.time + film[:, 0], atol=1e-3)
    np.testing.assert_allclose(z, film[:, 3], atol=1e-3)
    np.testing.assert_allclose(flight["film"]["turns"], film[:, 4:], atol=1e-4)
    assert np.diff(time).max() < 0.05


@in_a_browser
def test_the_page_shows_it_as_it_leans(landed, in_browser):
    """Pads where a vehicle that is turned by 20 degrees about x has them; the player goes on."""
    told = in_browser(
        landed[1],
        """
        const f = data.flight, k = f.film.first + 1, half = Math.PI / 18;
        f.film.turns[1] = [Math.cos(half), Math.sin(half), 0, 0];
        setMode("scene"); moment(k - 2);
        await until(() => root.dataset.scene || document.querySelector("#scene .warning"));
        if (space) {
          space.update();
          tellTest("paces", [frames.pause(), frames.step()]); moment(k);
          tellTest("filmed", [frames.pause(), frames.step()]);
          const pads = [];
          space.marks.traverse(o => { const about = o.geometry && o.geometry.parameters;
            if (about && about.radiusTop === data.lander.pad) pads.push(o.position.toArray()); });
          tellTest("pads", pads.slice(-4).map(([x, y, z]) => [x + space.middle.x - f.x[k],
            y + space.middle.y - f.y[k], z / space.high + space.z0 - f.z[k]]));
        }
        """,
    )
    if "pads" in told:
        assert told["paces"] == [250, 2] and told["filmed"] == [33, 1]
        turned = Rotation.from_euler("x", 20.0, degrees=True).apply(LANDER.pads)
        np.testing.assert_allclose(told["pads"], turned, atol=0.05)
