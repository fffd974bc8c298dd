# SPDX-License-Identifier: Apache-2.0
"""The page's controls in a real browser: each button, box, list and curve does what it says."""

import pytest
from report.pages import in_a_browser

pytestmark = in_a_browser


def test_buttons_of_the_map_zoom_and_boxes_show_and_hide(browse):
    told = browse(
        """
        const drawn = () => { drawNow(); const d = map.getContext("2d").getImageData(0, 0,
          map.width, map.height).data; let n = 0;
          for (let i = 0; i < d.length; i++) n = (31 * n + d[i]) | 0; return n; };
        const factor = act => { const was = view.scale; act(); return view.scale / was; };
        const click = id => () => byId(id).click();
        tellTest("closer", [click("zoom-in"), click("zoom-out"), () => map.dispatchEvent(
          new MouseEvent("dblclick", { clientX: 300, clientY: 300 }))].map(factor));
        byId("zoom-fit").click(); tellTest("whole", isWhole());
        for (let k = 0; k < 5; k++) drawn(); // a canvas that is often read is drawn otherwise
        tellTest("boxes", SHOWN.map(name => { const before = drawn(); byId(`show-${name}`).click();
          const now = drawn(); byId(`show-${name}`).click();
          return [name, before !== now, before === drawn()]; }));
        const row = document.querySelectorAll("tr[data-site]")[1];
        row.dispatchEvent(new MouseEvent("mouseenter"));
        tellTest("pointed", [view.cursor.x - sites[1].x, view.cursor.y - sites[1].y]);
        """
    )
    assert told["closer"] == pytest.approx([1.5, 1 / 1.5, 2.0]) and told["whole"]
    assert told["boxes"] == [
        [name, True, True] for name in ("sites", "relief", "excluded", "leaves", "track")
    ]
    assert told["pointed"] == [0, 0]


def test_a_second_layer_is_beside_with_the_same_view_and_crosshair(browse):
    told = browse(
        """
        const wide = width(); move("layer", "slope"); move("layer-2", "elevation"); drawNow();
        tellTest("halves", [width() / wide, second.clientWidth / wide]);
        tellTest("layers", [view.layer, view.beside]);
        const pixels = () => { drawNow(); return [...second.getContext("2d").getImageData(
          0, 0, second.width, second.height).data].join(); };
        for (let k = 0; k < 5; k++) pixels(); // a canvas that is often read is drawn otherwise
        const before = pixels(), y = height() / 2;
        tellTest("steady", before === pixels());
        at("pointermove", width() / 2, y); tellTest("crosshair", pixels() !== before);
        const place = view.x; at("pointerdown", 200, y); at("pointermove", 150, y);
        at("pointerup", 150, y); tellTest("moved", [view.x > place, pixels() !== before]);
        move("layer-2", ""); tellTest("alone", [second.hidden, width() / wide]);
        """
    )
    assert told["halves"] == pytest.approx([0.5, 0.5], abs=0.01)
    assert told["layers"] == ["slope", "elevation"] and told["steady"]
    assert told["crosshair"] and told["moved"] == [True, True] and told["alone"] == [True, 1]


def test_the_link_is_of_this_view(browse):
    told = browse(
        """
        const copied = [];
        Object.defineProperty(navigator, "clipboard", { value: { writeText: async link => {
          copied.push(link); } } });
        setLayer("slope"); zoom(2); byId("link").click();
        await until(() => byId("link").textContent === "copied");
        tellTest("copied", [copied, location.href.split("#")[0] + "#" + address()]);
        """
    )
    (link,), here = told["copied"]
    assert link == here and "layer=slope" in link and "scale=" in link


def test_the_flight_plays(browse):
    told = browse(
        """
        const last = frames.last, play = byId("play"), passed = new Set();
        frames.go(last - 2); play.click(); tellTest("playing", play.textContent);
        await until(() => { passed.add(frames.at()); return play.textContent === "▶"; });
        tellTest("passed", [...passed].map(k => k - last));
        play.click(); tellTest("again", frames.at()); play.click();
        const still = frames.at(); await new Promise(done => setTimeout(done, 600));
        tellTest("paused", [play.textContent, frames.at() - still]);
        """
    )
    assert told["playing"] == "❚❚" and told["passed"] == [-2, -1, 0]
    assert told["again"] == 0 and told["paused"] == ["▶", 0]


def test_views_change_by_tab_and_key_and_space_has_its_tools(browse):
    told = browse(
        """
        const mode = act => { act(); return [view.mode, byId("section").hidden,
          byId("scene").hidden]; };
        const tab = name => () => byId(name).click();
        tellTest("modes", [tab("mode-section"), tab("section-close"), () => press("3"),
          () => press("1"), tab("mode-scene"), tab("mode-map"), tab("mode-scene")].map(mode));
        await until(() => root.dataset.scene || document.querySelector("#scene .warning"));
        if (space) {
          const away = () => space.eye.position.distanceTo(space.controls.target);
          const factor = act => { const was = away(); act(); return away() / was; };
          tellTest("zoom", [tab("zoom-in"), tab("zoom-out"), () =>
            space.renderer.domElement.dispatchEvent(new WheelEvent("wheel", { deltaY: -100,
              cancelable: true }))].map(factor));
          move("exaggeration", 3);
          tellTest("height", space.ground.scale.z);
          const before = space.camera(); byId("scene-track").click();
          tellTest("track", [before !== space.camera(), byId("show-track").checked]);
          byId("zoom-fit").click();
          const canvas = space.renderer.domElement, box = canvas.getBoundingClientRect();
          canvas.dispatchEvent(new PointerEvent("pointermove", { clientX: box.left + box.width / 2,
            clientY: box.top + box.height / 2 }));
          tellTest("values", shown().height);
        } else tellTest("warning", document.querySelector("#scene .warning").textContent);
        """
    )
    section, plain, solid = ["section", False, True], ["map", True, True], ["scene", True, False]
    assert told["modes"] == [section, plain, solid, plain, solid, plain, solid]
    if "warning" in told:
        pytest.skip(told["warning"])
    assert told["zoom"][:2] == pytest.approx([0.8, 1.25], rel=1e-3) and told["zoom"][2] < 1
    assert told["height"] == 3 and told["track"] == [True, True]
    assert told["values"].endswith(" m")
