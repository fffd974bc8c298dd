// SPDX-License-Identifier: Apache-2.0
// Cross-section along a line: the planes of the cells, their standard deviation without the common
// pose error, and the truth.
"use strict";
const SAMPLES = 800;
let profile = null;
function startLine(x, y) { view.line = [{ x, y }, { x, y }]; }
function moveLine(x, y) {
  view.line[1] = { x, y };
  drawSection(); draw();
}
function defaultLine() { // west to east through the selected site or the centre
  const site = sites[Math.max(view.site, 0)];
  const y = site ? site.y : (extent.y0 + extent.y1) / 2;
  const middle = site ? site.x : (extent.x0 + extent.x1) / 2;
  const half = Math.min(6 * data.zone, (extent.x1 - extent.x0) / 2);
  return [{ x: middle - half, y }, { x: middle + half, y }];
}
function sampled() { // distance, height, height ± σ, truth
  const [a, b] = view.line, length = Math.hypot(b.x - a.x, b.y - a.y);
  const truth = data.layers.find(l => l.name === "truth");
  const columns = [[], [], [], [], []];
  for (let k = 0; k <= SAMPLES; k++) {
    const x = a.x + (b.x - a.x) * k / SAMPLES, y = a.y + (b.y - a.y) * k / SAMPLES;
    const r = leafAt(x, y), i = gridPointAt(x, y), h = seenAt(x, y) ? heightAt(x, y) : NaN;
    const s = r >= 0 && leaves.relative ? leaves.relative[r] : NaN;
    const known = v => (Number.isNaN(v) ? null : v);
    const row = [length * k / SAMPLES, known(h), known(h + s), known(h - s),
                 truth && i >= 0 ? known(truth.values[i]) : null];
    row.forEach((v, c) => columns[c].push(v));
  }
  return truth ? columns : columns.slice(0, 4);
}
function drawSection() {
  const [a, b] = view.line;
  if (Math.hypot(b.x - a.x, b.y - a.y) < 0.01) return;
  const columns = sampled();
  if (profile) { profile.setData(columns); return; }
  const none = { stroke: "transparent", points: { show: false }, value: valueWithUnit(" m"), spanGaps: false };
  const series = [{ label: "from A", value: (u, v) => (v === null ? "" : v.toFixed(2) + " m") },
    curve("height", CURVES[0], " m", { spanGaps: false, width: 2 }),
    { ...none, label: "+ 1 σ, relative" }, { ...none, label: "− 1 σ, relative" }];
  if (columns.length > 4) series.push(curve("truth", CURVES[1], " m", { spanGaps: false }));
  profile = plot(byId("section"), 170, {
    series, bands: [{ series: [2, 3], fill: "rgba(0,114,178,.25)" }],
    scales: { x: { time: false } },
    axes: [{ label: "distance from A, m" }, { label: "height, m" }] }, columns);
  profile.over.addEventListener("mousemove", follow);
  profile.over.addEventListener("mouseleave", hideTooltip);
}
function follow(e) { // move the crosshair on the map
  const [a, b] = view.line, length = Math.hypot(b.x - a.x, b.y - a.y) || 1;
  const share = profile.posToVal(e.offsetX, "x") / length;
  view.cursor = { x: a.x + (b.x - a.x) * share, y: a.y + (b.y - a.y) * share };
  draw();
}
function pointAt(x, y) { // move the crosshair of the section to the nearest point of the line
  if (!profile || !view.line || byId("section").hidden) return;
  const [a, b] = view.line, dx = b.x - a.x, dy = b.y - a.y;
  const share = clamp(((x - a.x) * dx + (y - a.y) * dy) / (dx * dx + dy * dy || 1), 0, 1);
  const left = Number.isNaN(share) ? -10 : profile.valToPos(share * Math.hypot(dx, dy), "x");
  if (Number.isFinite(left)) profile.setCursor({ left, top: 20 }, false);
}
function showSection(on) {
  byId("section").hidden = !on;
  if (on) { view.line = view.line || defaultLine(); drawSection(); resizePlots(); }
  else view.line = null;
}
