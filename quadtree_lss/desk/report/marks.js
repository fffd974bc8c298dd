// SPDX-License-Identifier: Apache-2.0
// Markers over the layers: sites, landing requests, scans, cursor, scale, axes.
"use strict";
function ring(c, x, y, radius, dash = []) {
  c.beginPath(); c.arc(px(x), py(y), radius * view.scale, 0, 2 * Math.PI);
  c.setLineDash([]); c.strokeStyle = "#fff"; c.lineWidth = 4; c.stroke();
  c.setLineDash(dash); c.strokeStyle = data.colours.site; c.lineWidth = 2; c.stroke();
  c.setLineDash([]);
}
function badge(c, x, y, text, chosen) {
  const p = px(x), q = py(y);
  c.beginPath(); c.arc(p, q, chosen ? 12 : 10, 0, 2 * Math.PI);
  c.fillStyle = chosen ? ink("--accent") : data.colours.site; c.fill();
  c.strokeStyle = "#fff"; c.lineWidth = 1.5; c.stroke();
  c.fillStyle = chosen ? ink("--paper") : "#fff"; c.font = "bold 12px system-ui, sans-serif";
  c.textAlign = "center"; c.textBaseline = "middle"; c.fillText(text, p, q + 0.5);
}
function drawTarget(c, x, y, others) { // others: [x, y] of the sites; the label is far from them
  ring(c, x, y, 1.12 * data.zone, [4, 4]);
  if (!others.some(([u, v]) => Math.hypot(px(u) - px(x), py(v) - py(y)) < 17)) { // beside the numbers
    c.beginPath(); c.arc(px(x), py(y), 5, 0, 2 * Math.PI);
    c.fillStyle = ink("--accent"); c.fill(); c.strokeStyle = "#fff"; c.lineWidth = 1.5; c.stroke();
  }
  const away = Math.max(0.8 * data.zone * view.scale, 14), wide = 60, high = 20;
  const far = others.filter(([u, v]) => Math.hypot(u - x, v - y) > data.zone);
  const room = ([left, top]) => Math.min(...far.map(([u, v]) =>
    Math.hypot(px(u) - left - wide / 2, py(v) - top - high / 2)));
  const corners = [[away, -away - high], [away, away], [-away - wide, -away - high], [-away - wide, away]]
    .map(([right, down]) => [px(x) + right, py(y) + down]);
  box(c, "target", ...corners.reduce((best, corner) => (room(corner) > room(best) + 1 ? corner : best)));
}
function drawSites(c) {
  if (view.answer >= 0) {
    data.history.sites[view.answer].forEach(([, x, y], k, all) => {
      const [, rx, ry] = all[all.length - 1 - k]; // the best one on top
      ring(c, rx, ry, data.zone); badge(c, rx, ry, all.length - k, false);
    });
    const [id, x, y] = data.history.targets[view.answer];
    if (id) drawTarget(c, x, y, data.history.sites[view.answer].map(([, u, v]) => [u, v]));
    return;
  }
  for (const site of [...sites].reverse()) {
    ring(c, site.x, site.y, data.zone);
    badge(c, site.x, site.y, site.rank, site.rank - 1 === view.site);
  }
  if (data.target) drawTarget(c, ...data.target, sites.map(s => [s.x, s.y]));
  if (data.miss) { ring(c, data.miss.x, data.miss.y, data.zone, [2, 4]); badge(c, data.miss.x, data.miss.y, "?"); }
}
function shape(c, points, colour) {
  if (!points || points.length < 2) return;
  c.beginPath();
  points.forEach(([x, y], k) => c[k ? "lineTo" : "moveTo"](px(x), py(y)));
  c.closePath(); c.setLineDash([8, 4]); c.lineWidth = 2; c.strokeStyle = colour; c.stroke();
  c.setLineDash([]);
}
function drawRequests(c) { // landing area, keep-out, target
  if (!data.flight) shape(c, data.landing.area, "#0072b2"); // a flight draws its own areas
  for (const name in data.landing) if (name.startsWith("keep_out")) shape(c, data.landing[name], "#d00");
  if (data.landing.target) {
    const [x, y] = data.landing.target, p = px(x), q = py(y);
    c.strokeStyle = "#0072b2"; c.lineWidth = 3; c.beginPath();
    c.moveTo(p - 8, q); c.lineTo(p + 8, q); c.moveTo(p, q - 8); c.lineTo(p, q + 8); c.stroke();
  }
}
function drawScans(c) { // track and footprints of the lidar up to the shown time
  const h = data.history;
  if (!h) return;
  const now = view.answer < 0 ? Infinity : h.seconds[view.answer];
  const last = h.scan_seconds.filter(t => t <= now).length;
  const outline = k => {
    c.beginPath();
    for (let j = 0; j < h.corners; j++) {
      const i = 2 * (k * h.corners + j);
      c[j ? "lineTo" : "moveTo"](px(h.outline[i]), py(h.outline[i + 1]));
    }
    c.closePath(); c.stroke();
  };
  c.lineWidth = 1; c.strokeStyle = "rgba(0,70,140,.35)";
  const step = Math.max(1, Math.ceil(last / 12));
  if (view.track) for (let k = 0; k < last; k += step) outline(k);
  c.strokeStyle = "#004c8c"; c.lineWidth = 1.5; c.beginPath();
  for (let k = 0; k < last; k++) {
    c[k ? "lineTo" : "moveTo"](px(h.position[3 * k]), py(h.position[3 * k + 1]));
  }
  c.stroke();
  if (last && view.answer >= 0) { c.lineWidth = 2.5; outline(last - 1); }
}
function drawPicks(c) { // picked places for the command line
  if (view.picks.length > 1) shape(c, view.picks.map(p => [p.x, p.y]), "#7a00a8");
  for (const { x, y } of view.picks) {
    c.beginPath(); c.arc(px(x), py(y), 4, 0, 7); c.fillStyle = "#7a00a8"; c.fill();
    c.strokeStyle = "#fff"; c.lineWidth = 1.5; c.stroke();
  }
}
function drawLine(c) {
  const [a, b] = view.line;
  c.strokeStyle = "#fff"; c.lineWidth = 4; c.beginPath();
  c.moveTo(px(a.x), py(a.y)); c.lineTo(px(b.x), py(b.y)); c.stroke();
  c.strokeStyle = "#c00000"; c.lineWidth = 2; c.stroke();
  badge(c, a.x, a.y, "A"); badge(c, b.x, b.y, "B");
  box(c, `${Math.hypot(b.x - a.x, b.y - a.y).toFixed(2)} m`, (px(a.x) + px(b.x)) / 2, (py(a.y) + py(b.y)) / 2);
}
function drawCursor(c) {
  const p = Math.round(px(view.cursor.x)) + 0.5, q = Math.round(py(view.cursor.y)) + 0.5;
  for (const [style, w] of [["rgba(255,255,255,.7)", 3], ["rgba(0,0,0,.75)", 1]]) {
    c.strokeStyle = style; c.lineWidth = w; c.beginPath();
    c.moveTo(p, 0); c.lineTo(p, q - 6); c.moveTo(p, q + 6); c.lineTo(p, height());
    c.moveTo(0, q); c.lineTo(p - 6, q); c.moveTo(p + 6, q); c.lineTo(width(), q); c.stroke();
  }
}
function box(c, text, x, y) { // label whose left edge is at x
  c.font = "600 13px system-ui, sans-serif"; c.textAlign = "left"; c.textBaseline = "top";
  c.fillStyle = ink("--panel"); c.fillRect(x, y, c.measureText(text).width + 12, 20);
  c.fillStyle = ink("--ink"); c.fillText(text, x + 6, y + 3);
}
function drawTitle(c, layer) { // title of the second pane: name, unit and colour range
  const range = layer.classes ? "" : `: ${layer.limits.map(v => inUnit(layer, v)).join(" … ")} ${layer.unit || ""}`;
  box(c, layer.title + range, MARGIN.left + 8, 8);
  if (layer.classes) return;
  for (let p = 0; p < 120; p++) {
    c.fillStyle = `rgb(${colour(layer, layer.limits[0] + (layer.limits[1] - layer.limits[0]) * p / 119)})`;
    c.fillRect(MARGIN.left + 14 + p, 30, 1.5, 10);
  }
}
function drawScaleBar(c) {
  const length = nice(110 / view.scale), p = length * view.scale;
  const x = MARGIN.left + 14, y = height() - MARGIN.bottom - 14;
  c.fillStyle = "rgba(255,255,255,.85)"; c.fillRect(x - 8, y - 24, p + 16, 32);
  c.strokeStyle = "#111"; c.lineWidth = 2; c.beginPath();
  c.moveTo(x, y - 5); c.lineTo(x, y); c.lineTo(x + p, y); c.lineTo(x + p, y - 5); c.stroke();
  c.fillStyle = "#111"; c.font = "12px system-ui, sans-serif"; c.textAlign = "center";
  c.textBaseline = "bottom"; c.fillText(plain(length, length) + " m", x + p / 2, y - 5);
}
function drawAxes(c) {
  const step = nice(80 / view.scale), bottom = height() - MARGIN.bottom;
  c.fillStyle = c.strokeStyle = ink("--soft-ink"); c.lineWidth = 1;
  c.font = "11px system-ui, sans-serif";
  c.strokeRect(MARGIN.left - 0.5, 0.5, width() - MARGIN.left, bottom - 0.5);
  c.textAlign = "center"; c.textBaseline = "top";
  for (let x = Math.ceil(mx(MARGIN.left) / step) * step; px(x) < width() - 34; x += step) {
    if (px(x) < MARGIN.left + 6) continue;
    c.beginPath(); c.moveTo(px(x), bottom); c.lineTo(px(x), bottom + 4); c.stroke();
    c.fillText(plain(x, step), px(x), bottom + 6);
  }
  c.textAlign = "right"; c.fillText("x, m", width() - 2, bottom + 16);
  c.textBaseline = "middle";
  for (let y = Math.ceil(my(bottom) / step) * step; py(y) > 20; y += step) {
    if (py(y) > bottom - 4) continue;
    c.beginPath(); c.moveTo(MARGIN.left - 4, py(y)); c.lineTo(MARGIN.left, py(y)); c.stroke();
    c.fillText(plain(y, step), MARGIN.left - 6, py(y));
  }
  c.textBaseline = "top"; c.fillText("y, m", MARGIN.left - 6, 2);
}
