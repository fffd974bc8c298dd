// SPDX-License-Identifier: Apache-2.0
// The program of report.html: draws the embedded columns, pans, zooms, tells values. It needs no
// library and no network. The element "data" holds the result of page_data.py as JSON.
"use strict";
const root = document.documentElement;
window.addEventListener("error", e => { root.dataset.error = e.message; });
const byId = id => document.getElementById(id);
const data = JSON.parse(byId("data").textContent);
const { grid, leaves, sites } = data;

// ---- columns --------------------------------------------------------------------------------
const KINDS = { u1: Uint8Array, u2: Uint16Array, u4: Uint32Array };
const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
function column(packed) {
  if (!packed) return null;
  const raw = new KINDS[packed.kind](bytes(packed.data).buffer);
  if (packed.step === undefined) return { at: i => raw[i], raw, limits: packed.limits };
  const none = packed.kind === "u1" ? 0xff : 0xffff;
  const at = i => (raw[i] === none ? NaN : packed.low + packed.step * raw[i]);
  return { at, raw, limits: packed.limits, mark: packed.mark };
}
const gridColumns = {};
for (const name of ["elevation", "slope", "score", "hazard", "safe"]) {
  gridColumns[name] = column(grid[name]);
}
const leaf = {};
for (const [name, packed] of Object.entries(leaves)) {
  if (packed.data !== undefined) leaf[name] = column(packed);
}
const LUT = {};
for (const name of ["viridis", "cividis", "magma"]) LUT[name] = bytes(data.colours[name]);
const rgb = hex => [1, 3, 5].map(k => parseInt(hex.slice(k, k + 2), 16));

// A leaf is found from a place by looking at each level, finest first.
const leafSize = level => leaves.size / 2 ** level;
const leafKey = (level, ix, iy) => (level * 65536 + ix) * 65536 + iy;
const leafRow = new Map();
for (let i = 0; i < leaves.number; i++) {
  leafRow.set(leafKey(leaf.level.raw[i], leaf.ix.raw[i], leaf.iy.raw[i]), i);
}
function leafAt(x, y) {
  const u = (x - leaves.xmin) / leaves.size, v = (y - leaves.ymin) / leaves.size;
  if (!(u >= 0 && u < 1 && v >= 0 && v < 1)) return -1;
  for (let level = leaves.max_level; level >= leaves.min_level; level--) {
    const n = 2 ** level, row = leafRow.get(leafKey(level, Math.floor(u * n), Math.floor(v * n)));
    if (row !== undefined) return row;
  }
  return -1;
}
function gridPointAt(x, y) {
  const i = Math.round((x - grid.xmin) / grid.spacing);
  const j = Math.round((y - grid.ymin) / grid.spacing);
  return i >= 0 && j >= 0 && i < grid.nx && j < grid.ny ? j * grid.nx + i : -1;
}

// ---- layers ---------------------------------------------------------------------------------
const UNKNOWN = [205, 205, 205];
function hazardClass(bits) {
  const k = data.hazards.findIndex(h => bits & h.bit);
  return k < 0 ? 0 : k + 1;
}
const hazardNames = bits =>
  data.hazards.filter(h => bits & h.bit).map(h => h.name).join(", ") || "none";
const UNSEEN = data.hazards[0];
const allowedClass = i =>
  (gridColumns.hazard.raw[i] & UNSEEN.bit ? 2 : gridColumns.safe.raw[i] ? 0 : 1);
const hazardClasses = [{ name: "none", colour: data.colours.clear }, ...data.hazards];
const allowedClasses = [
  { name: "allowed", colour: data.colours.safe },
  { name: "excluded", colour: data.colours.excluded },
  { name: "unseen", colour: UNSEEN.colour },
];
const onGrid = (title, unit, name, lut, none, reversed) =>
  ({ title, unit, of: "grid", value: gridColumns[name].at, limits: gridColumns[name].limits,
     mark: gridColumns[name].mark, lut, none, reversed });
const onLeaves = (title, unit, value, limits, lut) =>
  ({ title, unit, of: "leaf", value, limits, lut, none: "no estimate" });
const LAYERS = {
  elevation: onGrid("Elevation", "m", "elevation", "viridis", "unseen"),
  slope: onGrid("Slope at the lander's scale", "deg", "slope", "cividis", "unseen"),
  hazards: { title: "Hazards by kind", of: "grid", classes: hazardClasses,
             note: data.hazard_note, value: i => hazardClass(gridColumns.hazard.raw[i]) },
  allowed: { title: "Where landing is allowed", of: "grid", classes: allowedClasses,
             value: allowedClass },
  score: onGrid("Score, lower is better", "", "score", "viridis", "excluded", true),
  cells: onLeaves("Size of the leaves (log scale)", "m",
                  i => Math.log2(leafSize(leaf.level.raw[i])),
                  [leaves.max_level, leaves.min_level].map(l => Math.log2(leafSize(l))), "magma"),
};
if (leaf.sigma) {
  LAYERS.sigma = onLeaves("Uncertainty of height, 1 σ", "m", leaf.sigma.at,
                          leaf.sigma.limits, "magma");
  LAYERS.roughness = onLeaves("Roughness (distance from the plane)", "m", leaf.roughness.at,
                              leaf.roughness.limits, "magma");
}
function paint(layer) {
  const fine = 2 ** leaves.max_level, ofLeaf = layer.of === "leaf";
  const nx = ofLeaf ? fine : grid.nx, ny = ofLeaf ? fine : grid.ny;
  const canvas = document.createElement("canvas");
  canvas.width = nx; canvas.height = ny;
  const context = canvas.getContext("2d"), image = context.createImageData(nx, ny);
  const colours = layer.classes && layer.classes.map(c => rgb(c.colour));
  const put = (i, j, c, shade) => {
    const k = 4 * ((ny - 1 - j) * nx + i);
    for (let b = 0; b < 3; b++) image.data[k + b] = c[b] * shade;
    image.data[k + 3] = 255;
  };
  if (ofLeaf) {
    for (let r = 0; r < leaves.number; r++) {
      const side = 2 ** (leaves.max_level - leaf.level.raw[r]), c = colour(layer, layer.value(r));
      const i0 = leaf.ix.raw[r] * side, j0 = leaf.iy.raw[r] * side;
      for (let j = j0; j < j0 + side; j++) for (let i = i0; i < i0 + side; i++) put(i, j, c, 1);
    }
  } else {
    for (let j = 0; j < ny; j++) for (let i = 0; i < nx; i++) {
      const v = layer.value(j * nx + i);
      put(i, j, colours ? colours[v] : colour(layer, v), view.relief ? shade(i, j) : 1);
    }
  }
  context.putImageData(image, 0, 0);
  return canvas;
}
function colour(layer, value) {
  if (Number.isNaN(value)) return UNKNOWN;
  const [low, high] = layer.limits;
  let t = Math.min(Math.max((value - low) / (high - low || 1), 0), 1);
  if (layer.reversed) t = 1 - t;
  const k = 3 * Math.round(255 * t), lut = LUT[layer.lut];
  return [lut[k], lut[k + 1], lut[k + 2]];
}
function shade(i, j) { // light from the north-west
  const z = (a, b) => gridColumns.elevation.at(
    Math.min(Math.max(b, 0), grid.ny - 1) * grid.nx + Math.min(Math.max(a, 0), grid.nx - 1));
  const gx = (z(i + 1, j) - z(i - 1, j)) / (2 * grid.spacing);
  const gy = (z(i, j + 1) - z(i, j - 1)) / (2 * grid.spacing);
  const lit = (0.7 + 0.5 * (gx - gy)) / Math.hypot(gx, gy, 1) + 0.3;
  return Number.isNaN(lit) ? 1 : Math.min(Math.max(lit, 0.35), 1.25);
}

// ---- map ------------------------------------------------------------------------------------
const map = byId("map");
const view = { x: 0, y: 0, scale: 1, layer: "elevation", leaves: true, sites: true, relief: false };
const painted = {};
const extent = {
  x0: Math.min(leaves.xmin, grid.xmin), y0: Math.min(leaves.ymin, grid.ymin),
  x1: leaves.xmin + leaves.size, y1: leaves.ymin + leaves.size,
};
const MARGIN = { left: 46, bottom: 30 };
const width = () => map.clientWidth, height = () => map.clientHeight;
const px = x => MARGIN.left + (width() - MARGIN.left) / 2 + (x - view.x) * view.scale;
const py = y => (height() - MARGIN.bottom) / 2 - (y - view.y) * view.scale;
const mx = p => view.x + (p - MARGIN.left - (width() - MARGIN.left) / 2) / view.scale;
const my = p => view.y - (p - (height() - MARGIN.bottom) / 2) / view.scale;
function fit() {
  view.x = (extent.x0 + extent.x1) / 2; view.y = (extent.y0 + extent.y1) / 2;
  view.scale = 0.98 * Math.min((width() - MARGIN.left) / (extent.x1 - extent.x0),
                               (height() - MARGIN.bottom) / (extent.y1 - extent.y0));
  view.whole = { x: view.x, y: view.y, scale: view.scale };
  draw();
}
function resized() { // the whole map stays whole; another view stays where it is
  const { x, y, scale, whole } = view;
  if (x === whole.x && y === whole.y && scale === whole.scale) fit();
  else draw();
}
function zoom(factor, p = px(view.x), q = py(view.y)) {
  const x = mx(p), y = my(q);
  view.scale = Math.min(Math.max(view.scale * factor, 0.2 * Math.min(width(), height()) /
    leaves.size), 4000);
  view.x += x - mx(p); view.y += y - my(q);
  draw();
}
function fitCanvas(canvas) {
  const ratio = window.devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, w, h);
  return context;
}
function draw() {
  const c = fitCanvas(map), layer = LAYERS[view.layer];
  const key = view.layer + (view.relief && layer.of === "grid" ? "+relief" : "");
  painted[key] = painted[key] || paint(layer);
  const half = layer.of === "leaf" ? 0 : grid.spacing / 2;
  const ofLeaf = layer.of === "leaf";
  const x0 = ofLeaf ? leaves.xmin : grid.xmin - half, y0 = ofLeaf ? leaves.ymin : grid.ymin - half;
  const w = ofLeaf ? leaves.size : grid.nx * grid.spacing;
  const h = ofLeaf ? leaves.size : grid.ny * grid.spacing;
  c.save();
  c.beginPath(); c.rect(MARGIN.left, 0, width(), height() - MARGIN.bottom); c.clip();
  c.fillStyle = "#f4f4f4"; c.fillRect(0, 0, width(), height());
  c.imageSmoothingEnabled = false;
  c.drawImage(painted[key], px(x0), py(y0 + h), w * view.scale, h * view.scale);
  if (view.leaves) drawLeaves(c);
  if (view.sites) drawSites(c);
  drawScaleBar(c);
  c.restore();
  drawAxes(c);
}
function drawLeaves(c) {
  const left = mx(MARGIN.left), right = mx(width()), top = my(0);
  const bottom = my(height() - MARGIN.bottom);
  c.beginPath();
  for (let i = 0; i < leaves.number; i++) {
    const size = leafSize(leaf.level.raw[i]), p = size * view.scale;
    if (p < 3) continue;
    const x = leaves.xmin + leaf.ix.raw[i] * size, y = leaves.ymin + leaf.iy.raw[i] * size;
    if (x > right || x + size < left || y > top || y + size < bottom) continue;
    const a = px(x), b = py(y);
    c.moveTo(a, b - p); c.lineTo(a, b); c.lineTo(a + p, b);
  }
  c.strokeStyle = "rgba(0,0,0,.38)"; c.lineWidth = 0.5; c.stroke();
}
function drawSites(c) {
  for (const site of [...sites].reverse()) {
    const p = px(site.x), q = py(site.y), r = data.zone * view.scale;
    c.beginPath(); c.arc(p, q, r, 0, 2 * Math.PI);
    c.strokeStyle = "#fff"; c.lineWidth = 4; c.stroke();
    c.strokeStyle = data.colours.site; c.lineWidth = 2; c.stroke();
    c.beginPath(); c.arc(p, q, 9, 0, 2 * Math.PI);
    c.fillStyle = data.colours.site; c.fill();
    c.strokeStyle = "#fff"; c.lineWidth = 1.5; c.stroke();
    c.fillStyle = "#fff"; c.font = "bold 12px sans-serif";
    c.textAlign = "center"; c.textBaseline = "middle"; c.fillText(site.rank, p, q + 0.5);
  }
}
function nice(about) { // 1, 2 or 5 times a power of ten
  const power = 10 ** Math.floor(Math.log10(about)), m = about / power;
  return (m < 1.5 ? 1 : m < 3.5 ? 2 : m < 7.5 ? 5 : 10) * power;
}
const plain = (v, step) => v.toFixed(Math.max(0, Math.ceil(-Math.log10(step) - 1e-9)));
function drawScaleBar(c) {
  const length = nice(110 / view.scale), p = length * view.scale;
  const x = MARGIN.left + 14, y = height() - MARGIN.bottom - 14;
  c.fillStyle = "rgba(255,255,255,.85)"; c.fillRect(x - 8, y - 24, p + 16, 32);
  c.strokeStyle = "#111"; c.lineWidth = 2; c.beginPath();
  c.moveTo(x, y - 5); c.lineTo(x, y); c.lineTo(x + p, y); c.lineTo(x + p, y - 5); c.stroke();
  c.fillStyle = "#111"; c.font = "12px sans-serif"; c.textAlign = "center";
  c.textBaseline = "bottom"; c.fillText(plain(length, length) + " m", x + p / 2, y - 5);
}
function drawAxes(c) {
  const step = nice(80 / view.scale), bottom = height() - MARGIN.bottom;
  c.fillStyle = "#333"; c.strokeStyle = "#333"; c.lineWidth = 1; c.font = "11px sans-serif";
  c.strokeRect(MARGIN.left - 0.5, 0.5, width() - MARGIN.left, bottom - 0.5);
  c.textAlign = "center"; c.textBaseline = "top";
  for (let x = Math.ceil(mx(MARGIN.left) / step) * step; px(x) < width() - 34; x += step) {
    if (px(x) < MARGIN.left + 6) continue;
    c.beginPath(); c.moveTo(px(x), bottom); c.lineTo(px(x), bottom + 4); c.stroke();
    c.fillText(plain(x, step), px(x), bottom + 6);
  }
  c.textAlign = "right"; c.fillText("x, m", width() - 2, bottom + 16);
  c.textBaseline = "middle";
  for (let y = Math.ceil(my(bottom) / step) * step; py(y) > 14; y += step) {
    if (py(y) > bottom - 4) continue;
    c.beginPath(); c.moveTo(MARGIN.left - 4, py(y)); c.lineTo(MARGIN.left, py(y)); c.stroke();
    c.fillText(plain(y, step), MARGIN.left - 6, py(y));
  }
  c.textBaseline = "top"; c.fillText("y, m", MARGIN.left - 6, 2);
}

// ---- legend and values ----------------------------------------------------------------------
function legend() {
  const layer = LAYERS[view.layer], box = byId("legend");
  byId("layer-title").textContent = layer.title + (layer.unit ? `, ${layer.unit}` : "");
  if (layer.classes) {
    const counts = new Array(layer.classes.length).fill(0);
    const n = grid.nx * grid.ny;
    for (let i = 0; i < n; i++) counts[layer.value(i)]++;
    box.innerHTML = layer.classes.map((k, i) =>
      `<div><i style="background:${k.colour}"></i>${k.name}` +
      `<b>${(100 * counts[i] / n).toFixed(1)} %</b></div>`).join("") +
      (layer.note ? `<p class="note">${layer.note}</p>` : "");
    return;
  }
  const holes = layer.of === "grid" && holesOf(layer);
  box.innerHTML = "<canvas></canvas>" + (holes ? `<div><i style="background:` +
    `rgb(${UNKNOWN})"></i>${layer.none}<b>${(100 * holes).toFixed(1)} %</b></div>` : "");
  const canvas = box.firstChild, c = fitCanvas(canvas), w = canvas.clientWidth - 24;
  for (let p = 0; p < w; p++) {
    const [low, high] = layer.limits;
    c.fillStyle = `rgb(${colour(layer, low + (high - low) * p / (w - 1))})`;
    c.fillRect(12 + p, 0, 1.5, 14);
  }
  const [low, high] = layer.limits, log = view.layer === "cells";
  c.fillStyle = "#222"; c.font = "11px sans-serif"; c.textBaseline = "top";
  for (const v of ticks(layer)) {
    const p = 12 + w * (v - low) / (high - low || 1);
    const text = log ? short(2 ** v) : short(v), half = c.measureText(text).width / 2;
    c.fillRect(p - 0.5, 14, 1, 4);
    c.textAlign = "center";
    c.fillText(text, Math.min(Math.max(p, half), w + 24 - half), 20);
  }
}
function ticks(layer) { // round numbers; of sizes, powers of two
  const [low, high] = layer.limits;
  if (layer.mark !== undefined) return [low, layer.mark, high];
  const step = view.layer === "cells" ? Math.ceil((high - low) / 6) || 1 : nice((high - low) / 4);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) {
    found.push(k * step);
  }
  return found.length > 1 ? found : [low, high];
}
function holesOf(layer) {
  let count = 0;
  const n = grid.nx * grid.ny;
  for (let i = 0; i < n; i++) count += Number.isNaN(layer.value(i));
  return count / n;
}
const short = v => (Number.isNaN(v) ? "–" : Math.abs(v) >= 100 ? v.toFixed(0) :
  String(parseFloat(v.toPrecision(3))));
const metres = v => (Number.isNaN(v) ? "–" : v.toFixed(2) + " m");
function values(x, y) {
  const i = gridPointAt(x, y), r = leafAt(x, y);
  const rows = [["place", `${x.toFixed(2)}, ${y.toFixed(2)} m`]];
  if (i >= 0) {
    const slope = gridColumns.slope.at(i), score = gridColumns.score.at(i);
    rows.push(["elevation", metres(gridColumns.elevation.at(i))]);
    rows.push(["slope", Number.isNaN(slope) ? "–" : slope.toFixed(1) + "°"]);
    rows.push(["hazard", hazardNames(gridColumns.hazard.raw[i])]);
    rows.push(["landing", gridColumns.safe.raw[i] ? "allowed" : "not allowed"]);
    rows.push(["score", Number.isNaN(score) ? "excluded" : score.toFixed(4)]);
  }
  if (r >= 0) {
    rows.push(["leaf", `${short(leafSize(leaf.level.raw[r]))} m, level ${leaf.level.raw[r]}`]);
    if (leaf.sigma) {
      const s = leaf.sigma.at(r), height = leaf.feature.at(r);
      rows.push(["its plane", leaf.measured.raw[r] ? "measured" :
        Number.isNaN(s) ? "none" : "inherited"]);
      rows.push(["height", Number.isNaN(s) ? "–" :
        `${leaf.z.at(r).toFixed(3)} ± ${s.toFixed(3)} m`]);
      rows.push(["leaf's slope", Number.isNaN(s) ? "–" : leaf.slope.at(r).toFixed(1) + "°"]);
      rows.push(["measurements", leaf.count.raw[r]]);
      rows.push(["roughness", Number.isNaN(leaf.roughness.at(r)) ? "–" :
        leaf.roughness.at(r).toFixed(4) + " m"]);
      rows.push(["exceptions", Number.isNaN(leaf.exceptions.at(r)) ? "–" :
        (100 * leaf.exceptions.at(r)).toFixed(1) + " %"]);
      rows.push(["feature", Number.isNaN(height) ? "none" : height.toFixed(2) + " m high"]);
    }
  }
  return rows;
}
function tell(x, y) {
  byId("values").innerHTML =
    values(x, y).map(([k, v]) => `<tr><th>${k}</th><td>${v}</td></tr>`).join("");
}

// ---- what a person does -----------------------------------------------------------------------
const pointers = new Map();
map.addEventListener("pointerdown", e => {
  pointers.set(e.pointerId, e);
  try { map.setPointerCapture(e.pointerId); } catch (ignored) { /* a made-up event in a test */ }
});
map.addEventListener("pointerup", e => pointers.delete(e.pointerId));
map.addEventListener("pointercancel", e => pointers.delete(e.pointerId));
map.addEventListener("pointermove", e => {
  tell(mx(e.offsetX), my(e.offsetY));
  const last = pointers.get(e.pointerId);
  if (!last) return;
  if (pointers.size === 2) { // two fingers
    const other = [...pointers.values()].find(p => p.pointerId !== e.pointerId);
    const gap = p => Math.hypot(p.offsetX - other.offsetX, p.offsetY - other.offsetY);
    zoom(gap(e) / Math.max(gap(last), 1), other.offsetX, other.offsetY);
  } else {
    view.x -= (e.offsetX - last.offsetX) / view.scale;
    view.y += (e.offsetY - last.offsetY) / view.scale;
    draw();
  }
  pointers.set(e.pointerId, e);
});
map.addEventListener("wheel", e => {
  e.preventDefault();
  zoom(Math.exp(-0.0015 * e.deltaY), e.offsetX, e.offsetY);
}, { passive: false });
map.addEventListener("dblclick", e => zoom(2, e.offsetX, e.offsetY));
map.addEventListener("keydown", e => {
  const step = 60 / view.scale;
  const keys = { "+": () => zoom(1.4), "-": () => zoom(1 / 1.4), 0: fit,
    ArrowLeft: () => { view.x -= step; draw(); }, ArrowRight: () => { view.x += step; draw(); },
    ArrowUp: () => { view.y += step; draw(); }, ArrowDown: () => { view.y -= step; draw(); } };
  if (keys[e.key]) { e.preventDefault(); keys[e.key](); }
});
byId("zoom-in").onclick = () => zoom(1.5);
byId("zoom-out").onclick = () => zoom(1 / 1.5);
byId("zoom-fit").onclick = fit;
byId("layers").innerHTML = Object.entries(LAYERS).map(([name, layer]) =>
  `<label><input type="radio" name="layer" value="${name}"` +
  `${name === view.layer ? " checked" : ""}> ${layer.title}</label>`).join("");
byId("layers").addEventListener("change", e => { view.layer = e.target.value; legend(); draw(); });
for (const name of ["leaves", "sites", "relief"]) {
  byId("show-" + name).onchange = e => { view[name] = e.target.checked; draw(); };
}
for (const row of document.querySelectorAll("tr[data-site]")) {
  row.onclick = () => {
    const site = sites[row.dataset.site];
    view.x = site.x; view.y = site.y;
    view.scale = 0.2 * Math.min(width(), height()) / data.zone;
    tell(site.x, site.y); draw();
    map.scrollIntoView({ block: "nearest" });
  };
}
const filter = byId("filter");
filter.oninput = () => {
  for (const row of document.querySelectorAll("#configuration tbody tr")) {
    row.hidden = !row.textContent.toLowerCase().includes(filter.value.toLowerCase());
  }
};

// ---- charts -----------------------------------------------------------------------------------
const plots = [];
function chart(id, unit, series) {
  const canvas = byId(id), x = data.timing.seconds;
  if (!x.length) return;
  const box = { left: 62, right: 12, top: 22, bottom: 34 };
  const last = x[x.length - 1] || 1, top = 1.05 * Math.max(...series.flatMap(s => s.y), 1e-9);
  let hovered = -1;
  const paintChart = () => {
    const c = fitCanvas(canvas), w = canvas.clientWidth - box.left - box.right;
    const h = canvas.clientHeight - box.top - box.bottom;
    const p = t => box.left + w * t / last, q = v => box.top + h * (1 - v / top);
    c.font = "11px sans-serif"; c.lineWidth = 1; c.textBaseline = "middle"; c.textAlign = "right";
    const rise = nice(top / 4), run = nice(last / 8);
    for (let v = 0; v <= top; v += rise) {
      c.strokeStyle = "#e2e2e2"; c.beginPath(); c.moveTo(box.left, q(v)); c.lineTo(p(last), q(v));
      c.stroke(); c.fillStyle = "#333"; c.fillText(plain(v, rise), box.left - 6, q(v));
    }
    c.textAlign = "center"; c.textBaseline = "top";
    for (let t = 0; t <= last; t += run) c.fillText(plain(t, run), p(t), box.top + h + 6);
    c.fillText("time since the first scan, s", box.left + w / 2, box.top + h + 20);
    let at = box.left;
    c.textAlign = "left"; c.textBaseline = "top";
    for (const s of series) {
      c.strokeStyle = c.fillStyle = s.colour; c.lineWidth = 1.2; c.beginPath();
      s.y.forEach((v, i) => c[i ? "lineTo" : "moveTo"](p(x[i]), q(v)));
      c.stroke();
      if (s.y.length < 150) {
        s.y.forEach((v, i) => c.fillRect(p(x[i]) - 1.5, q(v) - 1.5, 3, 3));
      }
      const told = hovered < 0 ? "" : `: ${short(s.y[hovered])}${unit ? " " + unit : ""}`;
      const text = s.name + told;
      c.fillText(text, at, 4); at += c.measureText(text).width + 18;
    }
    if (hovered >= 0) {
      c.fillStyle = "#333"; c.fillText(`at ${x[hovered].toFixed(2)} s`, at, 4);
      c.strokeStyle = "#999"; c.beginPath(); c.moveTo(p(x[hovered]), box.top);
      c.lineTo(p(x[hovered]), box.top + h); c.stroke();
    }
  };
  canvas.addEventListener("pointermove", e => {
    const t = last * (e.offsetX - box.left) / (canvas.clientWidth - box.left - box.right);
    hovered = x.reduce((best, v, i) => (Math.abs(v - t) < Math.abs(x[best] - t) ? i : best), 0);
    paintChart();
  });
  canvas.addEventListener("pointerleave", () => { hovered = -1; paintChart(); });
  plots.push(paintChart);
  paintChart();
}
chart("chart-ms", "ms", [{ name: "map update, ms", y: data.timing.map_ms, colour: "#0072b2" }]);
chart("chart-leaves", "", [{ name: "leaves", y: data.timing.leaves, colour: "#d55e00" }]);
chart("chart-points", "", [
  { name: "points in the scan", y: data.timing.points, colour: "#777777" },
  { name: "points used", y: data.timing.used, colour: "#009e73" },
]);

window.addEventListener("resize", () => { legend(); resized(); plots.forEach(p => p()); });
fit();
legend();
if (sites.length) tell(sites[0].x, sites[0].y);
root.dataset.ready = "yes";
