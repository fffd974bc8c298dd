// SPDX-License-Identifier: Apache-2.0
// The map: one view of the ground on one or two panes that move together.
"use strict";
const view = { x: 0, y: 0, scale: 1, layer: "", beside: "", mode: "map", site: -1, answer: -1, moment: 0,
               sites: true, relief: true, excluded: true, leaves: false, track: false, cursor: null, line: null, opacity: 1,
               picks: [] };
const map = byId("map"), second = byId("map-2");
const MARGIN = { left: 46, bottom: 30 };
let extent, whole = 1;
const width = () => map.clientWidth, height = () => map.clientHeight;
const px = x => MARGIN.left + (width() - MARGIN.left) / 2 + (x - view.x) * view.scale;
const py = y => (height() - MARGIN.bottom) / 2 - (y - view.y) * view.scale;
const mx = p => view.x + (p - MARGIN.left - (width() - MARGIN.left) / 2) / view.scale;
const my = p => view.y - (p - (height() - MARGIN.bottom) / 2) / view.scale;

function wholeScale() {
  return 0.98 * Math.min((width() - MARGIN.left) / (extent.x1 - extent.x0),
                         (height() - MARGIN.bottom) / (extent.y1 - extent.y0));
}
function fit() { // show all observed ground
  view.x = (extent.x0 + extent.x1) / 2; view.y = (extent.y0 + extent.y1) / 2;
  view.scale = whole = wholeScale();
  draw();
}
function fitSites() { // initial view: all sites, or all observed ground
  fit();
  if (!sites.length) return;
  const room = 5 * data.zone, xs = sites.map(s => s.x), ys = sites.map(s => s.y);
  const box = [Math.max(Math.min(...xs) - room, extent.x0), Math.min(Math.max(...xs) + room, extent.x1),
               Math.max(Math.min(...ys) - room, extent.y0), Math.min(Math.max(...ys) + room, extent.y1)];
  view.x = (box[0] + box[1]) / 2; view.y = (box[2] + box[3]) / 2;
  view.scale = Math.max(whole, Math.min((width() - MARGIN.left) / (box[1] - box[0]),
                                        (height() - MARGIN.bottom) / (box[3] - box[2])));
  draw();
}
const isWhole = () => view.scale <= whole * 1.001;
function resized() { // keep a full view full; keep the position of other views
  if (!width()) return; // hidden, without a size
  if (isWhole()) fit();
  else { whole = wholeScale(); draw(); }
}
function zoom(factor, p = px(view.x), q = py(view.y)) {
  const x = mx(p), y = my(q);
  view.scale = clamp(view.scale * factor, 0.5 * whole, 4000);
  view.x += x - mx(p); view.y += y - my(q);
  draw();
}
function goTo(site) {
  Object.assign(view, { x: site.x, y: site.y });
  const frame = byId("frame"); // the map may be hidden
  view.scale = Math.max(whole, 0.16 * Math.min(frame.clientWidth, frame.clientHeight) / data.zone);
  draw();
}
function fitCanvas(canvas) {
  const ratio = view.printing ? 3 : window.devicePixelRatio || 1;
  const w = canvas.clientWidth, h = canvas.clientHeight;
  if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
    canvas.width = Math.round(w * ratio); canvas.height = Math.round(h * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, w, h);
  return context;
}
let pending = 0;
function draw() { // at most once per frame
  if (!pending) pending = requestAnimationFrame(() => { pending = 0; drawNow(); });
}
function drawNow() {
  if (view.mode === "scene") return;
  drawPane(map, view.layer);
  second.hidden = !view.beside;
  if (view.beside) drawPane(second, view.beside);
  saveView();
}
function drawPane(canvas, name) {
  const c = fitCanvas(canvas), layer = LAYERS[name];
  c.save();
  c.beginPath(); c.rect(MARGIN.left, 0, width(), height() - MARGIN.bottom); c.clip();
  c.fillStyle = ink("--void"); c.fillRect(0, 0, width(), height());
  c.imageSmoothingEnabled = false;
  c.globalAlpha = view.opacity;
  place(c, picture(name, view.answer));
  c.globalAlpha = 1;
  if (view.relief) {
    [c.globalCompositeOperation, c.globalAlpha] = reliefOf(layer);
    c.imageSmoothingEnabled = true;
    place(c, reliefPicture(view.answer));
    c.globalAlpha = 1; c.globalCompositeOperation = "source-over";
  }
  for (const kind of layer.outlines || []) drawOutline(c, kind.colour, edges(kind.name, hazardAt(kind)));
  if (view.excluded) hatch(c, name);
  if (view.leaves) drawLeaves(c);
  drawRequests(c);
  if (view.track || view.answer >= 0) drawScans(c);
  if (data.flight) drawFlight(c);
  if (view.sites) drawSites(c);
  drawPicks(c);
  if (view.line) drawLine(c);
  drawScaleBar(c);
  if (view.cursor) drawCursor(c);
  if (canvas === second) drawTitle(c, layer);
  c.restore();
  drawAxes(c);
}
// Blend mode and opacity of the relief; colours must remain recognisable in the legend.
const reliefOf = layer => (layer.map === "elevation" ? ["hard-light", 0.45] : ["soft-light", 0.5]);
function place(c, { canvas, box: [x, y, w, h] }) {
  c.drawImage(canvas, px(x), py(y + h), w * view.scale, h * view.scale);
}
const tile = document.createElement("canvas");
function hatch(c, name) { // hatch excluded ground, with one line width at each zoom
  const ratio = c.getTransform().a, canvas = document.createElement("canvas");
  canvas.width = width() * ratio; canvas.height = height() * ratio;
  const own = canvas.getContext("2d"), side = tile.width = tile.height = Math.round(7 * ratio);
  const line = tile.getContext("2d");
  line.lineWidth = 0.9 * ratio;
  line.strokeStyle = name === LANDING ? "rgba(0,0,0,.55)" : "rgba(0,0,0,.4)";
  for (const shift of [-side, 0, side]) {
    line.moveTo(shift, side); line.lineTo(shift + side, 0);
  }
  line.stroke();
  own.setTransform(ratio, 0, 0, ratio, 0, 0);
  own.imageSmoothingEnabled = false;
  place(own, excludedMask());
  own.setTransform(1, 0, 0, 1, 0, 0);
  own.globalCompositeOperation = "source-in";
  own.fillStyle = own.createPattern(tile, "repeat");
  own.fillRect(0, 0, canvas.width, canvas.height);
  c.drawImage(canvas, 0, 0, width(), height());
}
const outlines = {};
const hazardAt = kind => i => (grid.hazard[i] & kind.bit) > 0 && !(grid.hazard[i] & UNSEEN.bit);
function edges(name, at) { // x0, y0, x1, y1 of the outline of the grid points where at() is true
  if (outlines[name]) return outlines[name];
  const found = [], { nx, ny, spacing: s } = grid;
  const has = (i, j) => i >= 0 && j >= 0 && i < nx && j < ny && Boolean(at(j * nx + i));
  for (let j = 0; j <= ny; j++) for (let i = 0; i <= nx; i++) {
    const here = has(i, j), x = grid.xmin + (i - 0.5) * s, y = grid.ymin + (j - 0.5) * s;
    if (here !== has(i - 1, j)) found.push([x, y, x, y + s]);
    if (here !== has(i, j - 1)) found.push([x, y, x + s, y]);
  }
  return (outlines[name] = found);
}
function drawOutline(c, colour, sides) {
  const left = mx(0), right = mx(width()), low = my(height()), high = my(0);
  c.beginPath();
  for (const [x0, y0, x1, y1] of sides) {
    if (x1 < left || x0 > right || y1 < low || y0 > high) continue;
    c.moveTo(px(x0), py(y0)); c.lineTo(px(x1), py(y1));
  }
  c.strokeStyle = colour; c.lineWidth = clamp(view.scale * grid.spacing / 5, 0.8, 2); c.stroke();
}
function drawLeaves(c) {
  const left = mx(MARGIN.left), right = mx(width()), top = my(0);
  const bottom = my(height() - MARGIN.bottom);
  c.beginPath();
  for (let i = 0; i < leaves.number; i++) {
    const size = leafSize(leaves.level[i]), p = size * view.scale;
    if (p < 3) continue;
    const x = leaves.xmin + leaves.ix[i] * size, y = leaves.ymin + leaves.iy[i] * size;
    if (x > right || x + size < left || y > top || y + size < bottom) continue;
    const a = px(x), b = py(y);
    c.moveTo(a, b - p); c.lineTo(a, b); c.lineTo(a + p, b);
  }
  c.strokeStyle = "rgba(0,0,0,.38)"; c.lineWidth = 0.5; c.stroke();
}
