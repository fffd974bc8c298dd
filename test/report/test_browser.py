# SPDX-License-Identifier: Apache-2.0
"""The page in a real browser: what is seen, told, reached by keys, fingers and address."""

import html
import json

import numpy as np
import pytest
from report.pages import accessible, in_a_browser, sheets

from quadtree_lss.desk.exchange.saved import load_results
from quadtree_lss.desk.report.headline import verdict

pytestmark = in_a_browser


@pytest.fixture
def best(result):
    """Place of the best site and its row and column in the grid."""
    x, y, _ = result.assessment.sites.position[0]
    (row,), (column,) = np.nonzero(result.assessment.y == y), np.nonzero(result.assessment.x == x)
    return x, y, (row[0], column[0])


def test_the_first_screen_holds_map_table_and_answer(result, browse):
    told = browse("""
        const bottom = id => byId(id).getBoundingClientRect().bottom;
        tellTest("below", ["map", "sites", "legend"].map(bottom).concat(
          document.querySelector(".verdict").getBoundingClientRect().bottom));
        tellTest("high", innerHeight);
        tellTest("wide", root.scrollWidth <= innerWidth);
        fit();
        tellTest("fits", [extent.x0, extent.x1].map(px).concat([extent.y0, extent.y1].map(py)));
        tellTest("size", [width(), height()]);
        tellTest("layers", [...byId("layer").options].map(o => o.value));
        const facts = [...document.querySelectorAll(".trust div")];
        const told = f => [...f.children].map(c => c.textContent).concat(f.className);
        tellTest("trust", facts.map(told));
        const edge = e => getComputedStyle(e).borderLeftColor;
        tellTest("edges", [edge(document.querySelector(".verdict")), edge(facts[0])]);
    """)
    level, _, _, facts = verdict(load_results(result.out))
    assert told["trust"] == [[fact.name, fact.value, fact.level] for fact in facts]
    colours = {"good": "rgb(0, 158, 115)", "care": "rgb(230, 159, 0)", "none": "rgb(213, 94, 0)"}
    assert told["edges"] == [colours[level], colours[facts[0].level]]
    assert max(told["below"]) <= told["high"] and told["wide"]
    left, right, bottom, top = told["fits"]
    wide, high = told["size"]
    assert 0 < left < right <= wide and 0 <= top < bottom <= high
    assert right - left > 0.85 * (wide - 46) or bottom - top > 0.85 * (high - 30)
    assert told["layers"][0] == "landing"
    assert {"aim", "hazards", "elevation"} < set(told["layers"])


def test_the_pointer_tells_values_and_layers_differ(result, best, browse):
    x, y, place = best
    told = browse(f"""
        at("pointermove", px({x}), py({y}));
        tellTest("values", shown());
        tellTest("beside", [tooltip.hidden, view.cursor.x, view.cursor.y]);
        map.dispatchEvent(new PointerEvent("pointerleave"));
        tellTest("left", [tooltip.hidden, view.cursor]);
        const colours = {{}}, legends = {{}};
        for (const option of byId("layer").options) {{
          setLayer(option.value);
          colours[option.value] = colourAt(px({x}) + 16, py({y}) + 16);
          legends[option.value] = [byId("legend").textContent,
                                   LAYERS[option.value].limits && ticks(LAYERS[option.value])];
        }}
        tellTest("colours", colours);
        tellTest("legends", legends);
    """)
    values, sites = told["values"], result.assessment.sites
    height = result.assessment.elevation[place]
    assert float(values["height"].split()[0]) == pytest.approx(height, abs=0.03)
    assert values["hazard"] == "none" and values["landing"] == "allowed"
    assert float(values["score"]) == pytest.approx(sites.score[0], abs=2e-4)
    assert "level" in values["cell"]
    assert told["beside"][0] is False and told["left"] == [True, None]
    assert told["beside"][1:] == pytest.approx([x, y], abs=1e-5)
    assert len(set(told["colours"].values())) >= 5
    legends = told["legends"]
    assert "Outlines do not exclude landing" in legends["hazards"][0]
    assert "touchdowns off the aim (lss.dispersion)" in legends["landing"][0]
    assert "excluded" in legends["score"][0] and len(legends["score"][1]) > 2
    assert legends["cells"][1] == [-1, 0, 1, 2]  # binary logarithms of 0.5 m to 4 m


def test_the_label_of_the_target_covers_no_site(browse):
    told = browse("""
        const labels = [];
        window.box = (c, text, x, y) => { if (text === "target") labels.push([x, y]); };
        data.target = [sites[0].x, sites[0].y]; sites.length = 1; drawNow();
        for (let n = 0; n < 2; n++) {
          const [x, y] = labels[labels.length - 1];
          sites.push({ x: mx(x + 30), y: my(y + 10), rank: n + 2 }); drawNow();
        }
        tellTest("labels", labels);
        tellTest("sites", sites.map(s => [px(s.x), py(s.y)]));
    """)
    assert len({tuple(label) for label in told["labels"]}) == 3
    x, y = told["labels"][-1]
    assert not any(x < u < x + 60 and y < v < y + 20 for u, v in told["sites"])


def test_rows_and_keys(best, browse):
    told = browse("""
        const all = document.querySelectorAll("tr[data-site]");
        tellTest("rows", [all.length, [...all].every(row => row.tabIndex === 0)]);
        all[1].focus();
        press("ArrowUp", all[1]);
        tellTest("moved", document.activeElement === all[0]);
        press("Enter", all[0]);
        tellTest("centre", [view.x, view.y]);
        tellTest("why", byId("why").textContent);
        const scale = view.scale;
        press("+"); tellTest("closer", view.scale > scale);
        press("0"); tellTest("all", isWhole());
        const first = view.layer;
        press("l"); tellTest("next", view.layer !== first);
        map.focus(); const x = view.x;
        press("ArrowRight", map); tellTest("right", view.x > x);
        press("Enter", map); tellTest("told", shown().place);
        press("x"); tellTest("section", [view.mode, byId("section").hidden]);
        press("Escape"); tellTest("back", view.mode);
        move("filter", "lss.margin");
        const left = document.querySelectorAll("#configuration tbody tr:not([hidden])");
        tellTest("found", left.length);
    """)
    assert told["rows"][0] >= 1 and told["rows"][1] and told["moved"]
    assert told["centre"] == pytest.approx(best[:2]) and "Site 1" in told["why"]
    assert told["closer"] and told["all"] and told["next"] and told["right"]
    assert told["told"] and told["section"] == ["section", False] and told["back"] == "map"
    assert told["found"] == 1


@pytest.mark.slow
def test_the_address_leads_back_to_a_view(browse):
    there = browse("""
        setLayer("slope"); choose(0); setBeside("elevation"); zoom(1.5);
        byId("show-leaves").click(); setMode("section");
        tellTest("address", address());
    """)["address"]
    told = browse('tellTest("address", address());', address=f"#{there}", size=(1400, 900))
    assert told["address"] == there
    assert "layer=slope" in there and "mode=section" in there and "leaves" in there


def test_a_section_shows_the_planes_along_its_line(result, best, browse):
    x, y, (row, _) = best
    told = browse(f"""
        setMode("section");
        at("pointerdown", px({x} - 2), py({y})); at("pointermove", px({x} + 2), py({y}));
        at("pointerup", px({x} + 2), py({y}));
        tellTest("profile", sampled());
        tellTest("drawn", profile.data[1].length);
        await until(() => Number.isFinite(profile.valToPos(2, "x")));
        const over = profile.over.getBoundingClientRect();
        profile.over.dispatchEvent(new MouseEvent("mousemove", {{
          clientX: over.left + profile.valToPos(2, "x"), clientY: over.top + 10 }}));
        tellTest("cursor", [view.cursor.x, view.cursor.y]);
    """)
    distance, height, above, below = (np.array(c, float) for c in told["profile"])
    assert distance[-1] == pytest.approx(4.0, abs=0.05) and told["drawn"] == len(distance)
    assert np.all(above[np.isfinite(above)] > height[np.isfinite(above)])
    elevation = result.assessment.elevation[row]
    expected = np.interp(x - 2.0 + distance, result.assessment.x, elevation)
    assert np.nanmedian(np.abs(height - expected)) < 0.05
    np.testing.assert_allclose((above + below) / 2, height, atol=1e-9)
    assert told["cursor"] == pytest.approx([x, y], abs=0.05)


def test_the_slider_shows_the_map_growing(result, browse):
    """Ground, headline, facts and table are those of the shown assessment."""
    told = browse("""
        const h = data.history, last = h.seconds.length - 1;
        const unseen = k => { const { canvas } = picture("landing", k), none = rgb(UNSEEN.colour);
          const d = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
          let n = 0;
          for (let i = 0; i < d.length; i += 4) n += none.every((v, c) => v === d[i + c]);
          return n; };
        move("instant", 0);
        tellTest("at", [view.answer, byId("clock").textContent]);
        tellTest("unseen", [unseen(0), unseen(last)]);
        // Risks of the history agree with those at the end.
        tellTest("differing", grid.risk.reduce((sum, v, i) => sum + (Number.isNaN(v) ? 0 :
          Math.abs(Math.max(v, -4) - riskAt(i, last)) > 0.02), 0));
        const said = () => [...document.querySelectorAll("#facts div")].map(f =>
          [...f.children].map(c => c.textContent).concat(f.className));
        const all = () => [byId("verdict").className, byId("verdict").textContent, said(),
                           byId("sites").textContent];
        setInstant(last);
        const whole = all(), middle = last >> 1;
        setInstant(middle);
        const body = byId("sites").tBodies[0], then = h.sites[middle];
        tellTest("rows", [body.rows.length, then.length]);
        tellTest("first", [...body.rows[0].cells].map(c => c.textContent));
        tellTest("then", then[0]);
        tellTest("why", byId("why").textContent);
        tellTest("shown", [...all().slice(0, 3), h.verdicts[middle], h.seconds[middle]]);
        setLayer("elevation"); tellTest("note", byId("legend").textContent);
        setLayer("landing"); tellTest("share", byId("legend").textContent);
        setInstant(last); tellTest("end", view.answer);
        tellTest("same", JSON.stringify(all()) === JSON.stringify(whole));
        tellTest("again", byId("why").textContent);
    """)
    assert told["differing"] == 0
    assert told["rows"][0] == told["rows"][1] > 0
    _, x, y, _, _, share = told["then"]
    assert told["first"][:3] == ["1", f"{x:.2f}", f"{y:.2f}"]
    assert float(told["first"][3]) == pytest.approx(100 * share, abs=0.06)
    name, words, facts, then, seconds = told["shown"]
    assert name == f"verdict {then['level']}" and facts == then["facts"]
    assert words == f"At {seconds:.1f} s. {then['answer']} {then['ground']}"
    assert told["why"].startswith("At ") and told["again"].startswith("Site 1")
    assert "values at the end" in told["note"] and "allowed" in told["share"]
    assert told["same"]
    assert told["at"][0] == 0 and "site" in told["at"][1] and told["end"] == -1
    assert told["unseen"][0] >= told["unseen"][1]


@pytest.mark.slow
def test_space_shows_the_ground_and_the_lander(browse):
    told = browse("""
        setMode("scene");
        await until(() => root.dataset.scene || document.querySelector("#scene .warning"));
        const none = document.querySelector("#scene .warning");
        tellTest("warning", none ? none.textContent : "");
        if (space) {
          choose(0);
          const gl = space.renderer.getContext(), w = gl.drawingBufferWidth;
          const pixels = new Uint8Array(4 * w * gl.drawingBufferHeight);
          space.render();
          gl.readPixels(0, 0, w, gl.drawingBufferHeight, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
          const colours = new Set();
          for (let i = 0; i < pixels.length; i += 400) {
            colours.add(pixels[i] >> 4 | pixels[i + 1] & 240);
          }
          tellTest("colours", colours.size);
          refresh(); choose(0); // the map is hidden, and must be there when it is shown again
          setMode("map"); drawNow(); await until(() => width());
          tellTest("map", [view.scale / whole, view.x, view.y, address().includes("scale=0.00")]);
          const there = colourAt(px(view.x) + 20, py(view.y) + 20);
          tellTest("painted", there !== ink("--void").replace(/[^0-9,]/g, ""));
          setMode("scene"); space.update();
          const radius = data.lander.radius, pads = [];
          space.marks.traverse(o => {
            const about = o.geometry && o.geometry.parameters;
            if (about && about.radiusTop === data.lander.pad) pads.push(o.position.toArray());
          });
          tellTest("pads", pads.map(([x, y]) => Math.hypot(x + space.middle.x - sites[0].x,
            y + space.middle.y - sites[0].y) / radius));
          tellTest("gaps", pads.map(([x, y, z]) => z - 0.03 -
            space.on(x + space.middle.x, y + space.middle.y, 0).z));
        }
    """)
    if told["warning"]:
        pytest.skip(told["warning"])
    assert told["colours"] > 10 and told["painted"]
    assert told["map"][0] >= 1.0 and told["map"][3] is False
    assert told["pads"] == pytest.approx([1.0] * 4)  # at true scale ...
    assert all(-1e-6 < gap < 0.3 for gap in told["gaps"])  # ... and on the ground


@pytest.mark.slow
def test_it_can_be_used_by_all(text, in_browser):
    assert accessible(in_browser, text)


@pytest.mark.slow
def test_print_fits_two_pages(text, in_browser):
    assert 1 <= sheets(in_browser, text) <= 2


def test_without_javascript_there_is_the_table(text, tmp_path, _browser):
    host = f"""<html><body><iframe id="off" sandbox="allow-same-origin" width="1200" height="900"
    srcdoc="{html.escape(text)}"></iframe><script>const off = document.getElementById("off");
    off.onload = () => {{ const wide = what => off.contentDocument.querySelector(what).offsetWidth;
      document.documentElement.dataset.told = JSON.stringify(
        ["#sites", "#frame", ".choice"].map(wide)); }};
    </script></body></html>"""
    (tmp_path / "host.html").write_text(host)
    told = _browser.show((tmp_path / "host.html").as_uri(), (1400, 900))["told"]
    table, frame, choice = json.loads(told)
    assert table > 300 and frame == choice == 0
