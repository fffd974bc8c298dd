// SPDX-License-Identifier: Apache-2.0
// Input on the map by mouse, touch and keys; the tooltip with the values at the pointer.
"use strict";
function valuesAt(x, y) {
  const i = gridPointAt(x, y), r = leafAt(x, y);
  const rows = [["place", `${x.toFixed(2)}, ${y.toFixed(2)} m`]];
  const k = view.answer, seen = i >= 0 && (k < 0 ? !(grid.hazard[i] & UNSEEN.bit) : !isUnobservedAt(i, k));
  if (!seen) {
    const hit = k < 0 && i >= 0 && grid.hazard[i] & UNMAPPED.bit;
    rows.push(["ground", hit ? UNMAPPED.name : UNSEEN.name]);
  }
  else {
    const risk = grid.risk && (k < 0 ? grid.risk[i] : riskAt(i, k));
    rows.push(["landing", (k < 0 ? grid.safe[i] : allowedAt(i, k)) ? "allowed" : "excluded"]);
    if (grid.risk) rows.push(["fails here", chanceText(risk)]);
    if (grid.aim && k < 0) rows.push(["fails if aimed here", chanceText(grid.aim[i])]);
    if (k >= 0) return rows; // other values are only known for the last assessment
    const h = heightAt(x, y), s = r >= 0 && leaves.deviation ? leaves.deviation[r] : NaN;
    rows.push(["height", Number.isNaN(s) ? withUnit(h, 2, "m") :
      `${h.toFixed(3)} ± ${s.toFixed(3)} m`]);
    if (r >= 0 && leaves.relative) rows.push(["± without pose error", withUnit(leaves.relative[r], 3, "m")]);
    rows.push(["slope", `${withUnit(grid.slope[i], 1, "°")}, lander's scale`]);
    rows.push(["hazard", hazardNames(grid.hazard[i])]);
    rows.push(["score", Number.isNaN(grid.score[i]) ? "excluded" : grid.score[i].toFixed(4)]);
    for (const layer of data.layers) {
      rows.push([layer.title, layer.classes ? layer.classes[layer.values[i]].name :
        withUnit(layer.values[i], 3, layer.unit)]);
    }
  }
  if (k >= 0) return rows;
  if (r >= 0) {
    const of = leaves.z ? (leaves.measured[r] ? ", measured" : Number.isNaN(leaves.z[r]) ?
      ", no plane" : ", inherited") : "";
    rows.push(["cell", `${short(leafSize(leaves.level[r]))} m, level ${leaves.level[r]}${of}`]);
    if (leaves.z && leaves.measured[r]) {
      rows.push(["measurements", leaves.count[r]]);
      rows.push(["roughness", withUnit(leaves.roughness[r], 4, "m")]);
      if (leaves.exceptions[r] > 0) {
        rows.push(["exceptions", withUnit(100 * leaves.exceptions[r], 1, "%")]);
      }
      if (!Number.isNaN(leaves.feature[r])) {
        rows.push(["feature", withUnit(leaves.feature[r], 2, "m") + " high"]);
      }
    }
  }
  return rows;
}
const chanceText = v => (Number.isNaN(v) ? "–" : v <= -4 ? "≤ 0.01 %" : `${short(100 * 10 ** v)} %`);
const tooltip = byId("tooltip");
function showTooltip(x, y, canvas = map) { // and the crosshair on each pane
  const frame = byId("frame").getBoundingClientRect(), own = canvas.getBoundingClientRect();
  view.cursor = { x, y };
  placeTooltip(x, y, px(x) + own.left - frame.left, py(y) + own.top - frame.top);
  pointAt(x, y); draw();
}
function placeTooltip(x, y, p, q) { // p, q: position within the frame
  tooltip.innerHTML = "<table>" +
    valuesAt(x, y).map(([k, v]) => `<tr><th>${k}</th><td>${v}</td></tr>`).join("") + "</table>";
  tooltip.hidden = false;
  const frame = byId("frame"), w = tooltip.offsetWidth, h = tooltip.offsetHeight;
  const beside = (at, size, room) =>
    clamp(at + 16 + size > room ? at - size - 16 : at + 16, 0, Math.max(room - size, 0)) + "px";
  tooltip.style.left = beside(p, w, frame.clientWidth);
  tooltip.style.top = beside(q, h, frame.clientHeight);
}
function hideTooltip() {
  tooltip.hidden = true;
  if (!view.cursor) return;
  view.cursor = null;
  pointAt(NaN, NaN); draw();
}

function command() { // show the picked places as command-line options
  const places = view.picks.map(({ x, y }) => `${x.toFixed(2)},${y.toFixed(2)}`), box = byId("command");
  const far = view.picks.slice(1).map((p, k) => Math.hypot(p.x - view.picks[k].x, p.y - view.picks[k].y));
  const way = `${short(far.reduce((sum, d) => sum + d, 0))} m along the places`;
  const words = places.length < 2 ? [`--target ${places[0]}`] : places.length < 3 ? [way] :
    [`--area '${places.join(" ")}'`, `--keep-out '${places.join(" ")}'`, way];
  box.innerHTML = places.length ? "" : box.dataset.hint;
  if (places.length) for (const word of words) {
    box.append(Object.assign(document.createElement("code"), { textContent: word }), " ");
  }
}
function mark(p, q, more) { // pick a place; with shift, add it
  view.picks = [...(more ? view.picks : []), { x: mx(p), y: my(q) }];
  command(); draw();
}
function pick(p, q) { // select the site whose marker is there
  if (!view.sites || view.answer >= 0) return false;
  const k = sites.findIndex(s => Math.hypot(px(s.x) - p, py(s.y) - q) <= 13);
  if (k >= 0) { choose(k, false); hideTooltip(); }
  return k >= 0;
}
let drag = null; // current drag of the map or of an end of the section line
function addPointerHandlers(canvas) {
  canvas.addEventListener("pointerdown", e => {
    if (e.pointerType === "touch") return;
    drag = { p: e.offsetX, q: e.offsetY, moved: 0 };
    if (view.mode === "section") startLine(mx(e.offsetX), my(e.offsetY));
    try { canvas.setPointerCapture(e.pointerId); } catch (ignored) { /* synthetic event of a test */ }
  });
  const drop = () => { drag = null; };
  canvas.addEventListener("pointerup", e => {
    if (drag && drag.moved < 4 && view.mode === "map" && !pick(e.offsetX, e.offsetY)) {
      mark(e.offsetX, e.offsetY, e.shiftKey);
    }
    drop();
  });
  canvas.addEventListener("pointercancel", drop);
  canvas.addEventListener("pointerleave", e => { if (e.pointerType !== "touch") hideTooltip(); });
  canvas.addEventListener("pointermove", e => {
    if (e.pointerType === "touch") return;
    if (drag && view.mode === "section") moveLine(mx(e.offsetX), my(e.offsetY));
    else if (drag) {
      view.x -= (e.offsetX - drag.p) / view.scale; view.y += (e.offsetY - drag.q) / view.scale;
      const way = Math.hypot(e.offsetX - drag.p, e.offsetY - drag.q);
      drag = { p: e.offsetX, q: e.offsetY, moved: drag.moved + way };
    }
    showTooltip(mx(e.offsetX), my(e.offsetY), canvas);
  });
  canvas.addEventListener("wheel", e => { // at full view the page scrolls
    if (e.deltaY > 0 && isWhole() && !e.ctrlKey) return;
    e.preventDefault();
    zoom(Math.exp(-0.0015 * e.deltaY), e.offsetX, e.offsetY);
  }, { passive: false });
  canvas.addEventListener("dblclick", e => zoom(2, e.offsetX, e.offsetY));
  canvas.addEventListener("blur", hideTooltip);

  // One finger scrolls the page or draws a section; two move and zoom the map; a tap shows values.
  let last = null, tapped = null;
  const fingers = e => {
    const box = canvas.getBoundingClientRect();
    return [...e.touches].map(t => ({ p: t.clientX - box.left, q: t.clientY - box.top }));
  };
  canvas.addEventListener("touchstart", e => {
    const found = fingers(e);
    last = found.length === 2 ? found : null;
    tapped = found.length === 1 ? found[0] : null;
    if (tapped && view.mode === "section") startLine(mx(tapped.p), my(tapped.q));
  }, { passive: true });
  canvas.addEventListener("touchmove", e => {
    const found = fingers(e);
    if (found.length === 1 && view.mode === "section") {
      e.preventDefault(); tapped = null;
      moveLine(mx(found[0].p), my(found[0].q));
    } else if (found.length === 2 && last) {
      e.preventDefault();
      const middle = f => ({ p: (f[0].p + f[1].p) / 2, q: (f[0].q + f[1].q) / 2 });
      const gap = f => Math.max(Math.hypot(f[0].p - f[1].p, f[0].q - f[1].q), 1);
      const from = middle(last), to = middle(found);
      view.x -= (to.p - from.p) / view.scale; view.y += (to.q - from.q) / view.scale;
      zoom(gap(found) / gap(last), to.p, to.q);
      last = found;
    } else tapped = null;
  }, { passive: false });
  canvas.addEventListener("touchend", () => {
    if (tapped && view.mode !== "section" && !pick(tapped.p, tapped.q)) {
      showTooltip(mx(tapped.p), my(tapped.q), canvas);
    }
    last = tapped = null;
  });
}
function keys(e) {
  if (e.ctrlKey || e.metaKey || e.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(e.target.tagName)) return;
  const onMap = e.target === map, step = 60 / view.scale;
  const move = (dx, dy) => onMap && (() => { view.x += dx * step; view.y += dy * step; draw(); });
  const doing = { "+": () => zoom(1.4), "=": () => zoom(1.4), "-": () => zoom(1 / 1.4), 0: fit,
    1: () => setMode("map"), 3: () => setMode("scene"), x: () => setMode("section"),
    l: nextLayer, Escape: () => { hideTooltip(); view.picks = []; command(); draw(); if (view.mode === "section") setMode("map"); },
    ArrowLeft: move(-1, 0), ArrowRight: move(1, 0), ArrowUp: move(0, 1), ArrowDown: move(0, -1),
    Enter: onMap && (() => showTooltip(view.x, view.y)) }[e.key];
  if (!doing || (view.mode === "scene" && "+=-0".includes(e.key))) return;
  e.preventDefault(); doing();
  if (onMap && view.cursor && e.key.startsWith("Arrow")) showTooltip(view.x, view.y);
}
