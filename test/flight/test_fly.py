# SPDX-License-Identifier: Apache-2.0
"""Whole flights in lock-step, from 250 m of range to save time."""

import json

import numpy as np
import pytest
from report.pages import Page, accessible, in_a_browser, sheets

from quadtree_lss.cli import main
from quadtree_lss.lab.flight.flight_page import write_flight
from quadtree_lss.lab.flight.fly import fly_lockstep
from quadtree_lss.lab.flight.ground import Ground
from quadtree_lss.lab.flight.settings import FlightError, flight_settings
from quadtree_lss.lab.simulation.terrain import SimulationError, Terrain
from quadtree_lss.onboard.core.landing.target import State

SHORT = {"slant_range": 260.0, "speed": 26.0, "half": 8.0, "scatter": 3.0, "survey": 3.0}
SEED = 40049


def fly(**more):
    return fly_lockstep(SEED, flight_settings({**SHORT, **more})).figures


def predicted_risk(done):
    """Return the predicted risk of the touchdown, by the last map. Below the gate the target stays
    the same, even if later returns put it within the margin of unsafe ground."""
    last, x, y = done.last, done.figures["x"], done.figures["y"]
    return last.risk[abs(last.y - y).argmin(), abs(last.x - x).argmin()]


@pytest.fixture(scope="module")
def short():
    faults = ("pose_gap@60+1",)
    return fly_lockstep(SEED, flight_settings({**SHORT, "faults": faults}), record=True)


def test_it_lands_safely_on_the_target(short):
    figures = short.figures
    assert figures["outcome"] == "touchdown" and figures["safe"], figures
    assert figures["error"] < 0.5 and figures["map_said"] in ("safe", "partly_unobserved", "unsafe")
    assert predicted_risk(short) < 0.01 and short.last.selected.id
    chosen = [d for d in short.flight.pilot.decisions if d.what in ("target", "divert")]
    assert any(d.what == "target" for d in chosen)
    assert all(d.height >= short.flight.settings.rules.gate for d in chosen)


@pytest.mark.slow
def test_the_same_seed_is_the_same_flight(short):
    assert fly(faults=("pose_gap@60+1",)) == short.figures


def test_without_avoidance_it_lands_on_the_planned_point_and_by_perfect_knowledge_safely():
    figures = fly(avoidance="none")
    assert figures["outcome"] == "touchdown" and figures["soft"]
    assert figures["from_planned"] < 0.5 and figures["map_said"] == "nothing"
    assert fly(avoidance="perfect", rocks=0.1)["safe"]


def test_a_target_outlives_the_node_that_chose_it():
    flight = fly_lockstep(SEED, flight_settings({**SHORT, "faults": ("kill_lss@60+2",)})).flight
    done = [decision.what for decision in flight.pilot.decisions]
    assert "target" in done and "lost" not in done, done


def test_land_now_is_flown_to_the_ground():
    done = fly_lockstep(SEED, flight_settings({**SHORT, "faults": ("land_now@60",)}))
    assert done.last.selected.state is State.NOW and done.figures["outcome"] == "touchdown"
    away = np.hypot(*(done.last.selected.position - done.flight.lander.position)[:2])
    assert away < 1.0 and done.figures["map_said"] == "safe"


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault", ["kill_lss@60", "kill_mapping@40", "forget_mapping@40", "keep_out@22", "keep_out@12"]
)
def test_no_fault_ends_on_ground_that_was_known_to_be_unsafe(fault):
    """And a target outlives a node that comes back with its checkpoint, but not a map that is
    forgotten."""
    done = fly_lockstep(SEED, flight_settings({**SHORT, "faults": (fault,)}))
    landed_safely = done.figures["safe"] and predicted_risk(done) < 0.01
    assert landed_safely or done.figures["outcome"] == "aborted", done.figures
    if "mapping" in fault:
        lost = "lost" in [decision.what for decision in done.flight.pilot.decisions]
        assert lost == fault.startswith("forget")


def test_rocks_are_strewn_on_a_terrain_if_asked_for(tmp_path):
    posts = np.linspace(-60.0, 60.0, 61)
    np.savez(tmp_path / "flat.npz", x=posts, y=posts, elevation=np.zeros((61, 61)))
    given = {"terrain": str(tmp_path / "flat.npz"), "avoidance": "none"}
    bare, rocky = (
        Ground.of(flight_settings({**given, **more}), np.random.default_rng(1))
        for more in ({}, {"rocks": 0.2})
    )
    assert not bare.terrain.elevation.any() and bare.safe[2].min() > 0.0
    assert rocky.terrain.elevation.max() > 0.3 and (rocky.safe[2] == 0.0).any()
    np.savez(tmp_path / "flat.npz", x=posts[29:32], y=posts[29:32], elevation=np.zeros((3, 3)))
    with pytest.raises(SimulationError, match="too small"):
        Ground.of(flight_settings(given), np.random.default_rng(1))


def test_a_ridge_on_the_way_is_ground_too():
    posts = np.linspace(-100.0, 100.0, 101)
    ridge = np.broadcast_to(np.where(np.abs(posts + 80.0) < 5.0, 90.0, 0.0), (101, 101))
    ground = Ground(Terrain(posts, posts, ridge), np.zeros(3), 10.0)
    assert ground.touches(np.array([-80.0, 0.0, 50.0]))
    assert not ground.touches(np.array([0.0, 0.0, 50.0]))


WRONG_TIMES = ("nan", "inf", "-1", "60+-3", "60+1e99", "60+nan", "60+0")


@pytest.mark.parametrize(
    ("values", "word"),
    [
        (
            {"avoidance": "luck"},
            "unknown avoidance 'luck'; there are package, paper, none, perfect",
        ),
        ({"speeed": 3.0}, "speeed"),
        ({"faults": ("meteor@50",)}, "meteor"),
        ({"faults": ("pose_gap",)}, "KIND@HEIGHT"),
        ({"half": -3.0}, "half must be between 2 and 10000, not -3"),
        ({"outliers": "many"}, "outliers must be between 0 and 1, not many"),
        ({"survey": 0.0}, "survey must be"),
        *(({"faults": (f"kill_mapping@{when}",)}, "from 0 to") for when in WRONG_TIMES),
    ],
)
def test_wrong_settings_are_one_clear_error(values, word):
    with pytest.raises(FlightError, match=word):
        flight_settings(values)


def test_the_command_writes_figures_and_page(tmp_path, capsys, monkeypatch):
    out = tmp_path / "flight"
    code = main(["fly", "--lockstep", "--seed", "3", "--avoidance", "none", "--out", str(out)])
    assert code == 0 and "touchdown" in capsys.readouterr().out
    figures = json.loads((out / "touchdown.json").read_text())
    assert {"safe", "x", "y", "error", "propellant", "diverts"} <= figures.keys()
    assert (out / "decisions.csv").exists() and not (out / "flight.html").exists()  # no map
    assert main(["fly", "--lockstep", "--fault", "x@1", "--out", str(out)]) == 1
    monkeypatch.setattr("quadtree_lss.lab.flight.fly.fly_lockstep", None)
    assert main(["fly", "--lockstep", "--out", str(out / "flight.csv" / "none")]) == 1
    assert "cannot be written" in capsys.readouterr().err


@pytest.fixture(scope="module")
def text(short, tmp_path_factory):
    out = tmp_path_factory.mktemp("flight") / "out"
    write_flight(out, short)
    return (out / "flight.html").read_text()


def test_the_page_is_that_of_the_map_with_the_flight(short, text):
    """And the folder is one of results."""
    found = Page(text)
    flight, samples = found.data["flight"], short.flight.samples
    np.testing.assert_allclose(found.column(flight["z"]), [s.z for s in samples], atol=1e-4)
    assert [d[2] for d in flight["decisions"]] == [d.what for d in short.flight.pilot.decisions]
    ((kind, begin, end),) = flight["faults"]
    assert kind == "pose_gap" and end - begin == pytest.approx(1.0)
    assert flight["areas"] and len(flight["areas"]) == len(short.flight.areas)
    layers = {layer["name"]: found.column(layer["values"]) for layer in found.data["layers"]}
    data = found.data["grid"]
    x, y = (data[f"{axis}min"] + data["spacing"] * np.arange(data[f"n{axis}"]) for axis in "xy")
    true = short.flight.ground.terrain.elevation_at(*np.meshgrid(x, y)).ravel()
    np.testing.assert_allclose(layers["truth"], true, atol=1e-3)
    at_x, at_y, _ = short.flight.lander.position
    here = np.hypot(*np.meshgrid(x - at_x, y - at_y)).argmin()
    assert layers["stands"][here] == 0  # a safe touchdown
    assert len(text) < 5e6 and 'class="verdict good"' in text


@in_a_browser
def test_a_flight_is_gone_over(text, in_browser):
    """Map, lander, headline and decisions are of the moment; a click on a decision goes there."""
    told = in_browser(
        text,
        """
        const f = data.flight, seen = () => [...Array(grid.nx * grid.ny).keys()].filter(
          i => !(view.answer < 0 ? grid.hazard[i] & 128 : isUnobservedAt(i, view.answer))).length;
        const slider = byId("instant");
        const at = k => { slider.value = k; slider.dispatchEvent(new Event("input"));
          return [view.answer, seen(), byId("clock").textContent, byId("verdict").textContent]; };
        tellTest("end", [frames.last, f.time.length, view.answer]);
        const early = frames.last >> 5;
        tellTest("moments", [early, frames.last].map(at));
        const last = f.decisions.length - 1;
        document.querySelectorAll("#decisions tbody tr")[last].click();
        tellTest("there", [momentTime(), f.decisions[last][0]]);
        const [kind, begin] = f.faults[0]; showMoment(sampleAt(begin + 0.5));
        view.sites = view.excluded = view.relief = false;
        view.x = f.x[view.moment]; view.y = f.y[view.moment]; view.scale = 200; drawNow();
        const red = () => { drawNow();
          const d = map.getContext("2d").getImageData(0, 0, map.width, map.height).data;
          let n = 0; for (let i = 0; i < d.length; i += 4) {
            n += d[i] === 0xd5 && d[i + 1] === 0x5e && d[i + 2] === 0; } return n; };
        const during = red(); showMoment(sampleAt(begin - 1)); tellTest("fault", [during, red()]);
        showMoment(frames.last); setMode("scene");
        await until(() => root.dataset.scene || document.querySelector("#scene .warning"));
        if (space) {
          const pads = [], truth = data.layers.find(l => l.name === "truth");
          space.update();
          space.marks.traverse(o => { const about = o.geometry && o.geometry.parameters;
            if (about && about.radiusTop === data.lander.pad) pads.push(o.position.toArray()); });
          tellTest("pads", pads.slice(-4).map(([x, y, z]) => z - 0.03 + space.z0 -
            truth.values[gridPointAt(x + space.middle.x, y + space.middle.y)]));
        }
        """,
    )
    (_, seen, clock, verdict), (answer, all_seen, end, own) = told["moments"]
    assert told["end"][0] == told["end"][1] - 1 and told["end"][2] == answer == -1
    assert 0 < seen <= all_seen and clock != end and verdict.startswith("At ")
    assert own.startswith("Safe touchdown") and abs(told["there"][0] - told["there"][1]) < 0.11
    assert told["fault"][0] > 10 > told["fault"][1]
    assert all(-0.1 < gap < 0.3 for gap in told.get("pads", [0.0])), told


@in_a_browser
def test_a_moment_has_its_view_reach_and_target_on_the_map_and_in_space(text, in_browser):
    """A click on a target's row shows its moment."""
    told = in_browser(
        text,
        """
        const f = data.flight, h = data.history;
        const rows = document.querySelectorAll("#targets tbody tr");
        rows[0].click(); tellTest("target", [momentTime(), Number(rows[0].cells[0].textContent),
          rows[0].cells[1].textContent]);
        view.sites = view.excluded = view.relief = false; fit();
        const drawn = () => { drawNow(); return [...map.getContext("2d").getImageData(
          0, 0, map.width, map.height).data].join(); };
        const differs = (without, back) => { const was = drawn(); without(); const now = drawn();
          back(); return [was !== now, was === drawn()]; };
        for (let n = 0; n < 5; n++) drawn(); // a canvas that is often read is drawn otherwise
        const { areas } = f, { outline } = h;
        tellTest("reach", differs(() => { f.areas = []; }, () => { f.areas = areas; }));
        tellTest("view", differs(() => { h.outline = outline.map(() => NaN); },
                                 () => { h.outline = outline; }));
        setMode("scene");
        await until(() => root.dataset.scene || document.querySelector("#scene .warning"));
        const inSpace = () => { const found = []; let low = Infinity;
          space.marks.traverse(o => {
            if (o.isLine) found.push(o.material.color.getHexString());
            const about = o.geometry && o.geometry.parameters;
            if (about && about.radiusTop === data.lander.pad) low = Math.min(low, o.position.z); });
          return [found.filter(c => c === "6fa8dc").length, found.includes("0072b2"),
                  low - 0.03 + space.z0 - f.z[view.moment]]; };
        if (space) { tellTest("space", inSpace()); showMoment((f.time.length >> 1) + 20);
          tellTest("later", [view.moment, ...inSpace()]); tellTest("corners", h.corners); }
        """,
    )
    time, row, why = told["target"]
    assert 0 <= time - row < 0.2 and why
    assert told["reach"] == told["view"] == [True, True]
    if "space" in told:
        for rays, reach, gap in (told["space"], told["later"][1:]):
            assert rays == told["corners"] / 3 and reach and gap == pytest.approx(0, abs=1e-3)


@in_a_browser
@pytest.mark.slow
def test_its_page_can_be_used_by_all_and_prints_on_two_sheets(text, in_browser):
    assert accessible(in_browser, text) and 1 <= sheets(in_browser, text) <= 2
