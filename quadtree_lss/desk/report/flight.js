// SPDX-License-Identifier: Apache-2.0
// A flight on its map: path, reachable area, decisions, faults, height, speed, touchdown. The time slider
// selects one of its samples.
"use strict";
const flightCharts = [], MARK = "#e69f00", FAILED = "#d55e00", PATH = "#004c8c";
const sampleAt = t => { // index of the last sample at a time of flight
  const times = data.flight.time, k = times.findIndex(v => v > t + 1e-3);
  return k < 0 ? times.length - 1 : Math.max(k - 1, 0);
};
const momentTime = () => data.flight.time[view.moment];
const eventRows = () => document.querySelectorAll("#decisions tbody tr, #targets tbody tr");
function showMoment(i) { // show map, sites and lander at sample i
  const f = data.flight, h = data.history, t = () => momentTime() - f.before;
  view.moment = clamp(i, 0, frames.last);
  if (h) {
    const known = h.seconds.filter(s => s <= t() + 1e-3).length - 1, last = h.seconds.length - 1;
    setInstant(view.moment === frames.last ? last : clamp(known, 0, last - 1));
  }
  byId("instant").value = view.moment;
  byId("clock").textContent = `${momentTime().toFixed(1)} s · ` +
    `${Math.max(f.height[view.moment], 0).toFixed(1)} m over the aim · ${f.speed[view.moment].toFixed(1)} m/s`;
  for (const row of eventRows()) {
    row.style.opacity = Number(row.cells[0].textContent) <= momentTime() + 0.05 ? 1 : 0.4;
  }
  for (const chart of flightCharts) chart.redraw(false);
  if (space) space.update();
  draw();
}
function startFlight() {
  const f = data.flight;
  if (!f) return;
  f.height = Array.from(f.z, z => z - f.aim[2]);
  f.speed = Array.from(f.time, (t, k) => {
    const a = Math.max(k - 1, 0), b = Math.min(k + 1, f.time.length - 1);
    return Math.hypot(f.x[b] - f.x[a], f.y[b] - f.y[a], f.z[b] - f.z[a]) / (f.time[b] - f.time[a] || 1);
  });
  Object.assign(frames, { last: f.time.length - 1, step: 2, at: () => view.moment, go: showMoment });
  view.moment = frames.last;
  const marks = u => { // faults as bars, decisions and the shown time as lines
    const c = u.ctx, { top, height: high } = u.bbox, at = t => u.valToPos(t - f.before, "x", true);
    c.save();
    for (const [, begin, end] of f.faults) {
      c.fillStyle = "rgba(213,94,0,.25)"; c.fillRect(at(begin), top, Math.max(at(end) - at(begin), 3), high);
    }
    for (const [t] of f.decisions) { c.fillStyle = MARK; c.fillRect(at(t), top, 1.5, high); }
    c.fillStyle = ink("--ink"); c.fillRect(at(momentTime()), top, devicePixelRatio, high);
    c.restore();
  };
  const curves = [["height, m", f.height, " m", 0], ["speed, m/s", f.speed, " m/s", 2]];
  const room = document.createElement("div");
  byId("time").append(room);
  for (const [label, values, unit, tone] of curves) {
    flightCharts.push(plot(room, 110, {
      series: [{ label: "time", value: second_s }, curve(label, CURVES[tone], unit)],
      scales: { x: { time: false } }, axes: [{ label: "time, s" }, { label }], legend: { show: false },
      hooks: { draw: [marks] }, cursor: { sync: { key: "flight" },
        bind: { mousedown: u => () => { showMoment(u.cursor.idx); return null; } } },
    }, [Array.from(f.time, t => t - f.before), values]));
  }
  for (const row of eventRows()) row.onclick = () => showMoment(sampleAt(Number(row.cells[0].textContent) + 0.1));
  byId("time").hidden = false;
  player();
  showMoment(frames.last);
}
function drawFlight(c) { // on the map
  const f = data.flight, t = momentTime(), k = view.moment;
  const area = f.areas.filter(([s]) => s <= t).pop();
  if (area && k < frames.last) shape(c, area[1], "#0072b2");
  const way = (from, to, colour, wide) => {
    c.beginPath(); c.strokeStyle = colour; c.lineWidth = wide;
    for (let n = from; n <= to; n++) c[n > from ? "lineTo" : "moveTo"](px(f.x[n]), py(f.y[n]));
    c.stroke();
  };
  way(0, k, "#fff", 4.5); way(0, k, PATH, 2.5);
  for (const [, begin, end] of f.faults) {
    if (begin <= t) way(sampleAt(begin), sampleAt(Math.min(end, t)), FAILED, 4);
  }
  const [x, y] = [px(f.planned[0]), py(f.planned[1])]; // a cross at the planned point
  c.beginPath(); c.strokeStyle = "#111"; c.lineWidth = 2.5;
  c.moveTo(x - 6, y - 6); c.lineTo(x + 6, y + 6); c.moveTo(x - 6, y + 6); c.lineTo(x + 6, y - 6); c.stroke();
  for (const [s, , , u, v] of f.decisions) {
    if (s > t) continue;
    c.beginPath(); c.arc(px(u), py(v), 4.5, 0, 7); c.fillStyle = MARK; c.fill();
    c.strokeStyle = "#111"; c.lineWidth = 1; c.stroke();
  }
  const { radius, pad } = data.lander;
  ring(c, f.x[k], f.y[k], radius);
  for (let n = 0; n < 4; n++) {
    const turn = Math.PI * (0.25 + 0.5 * n);
    ring(c, f.x[k] + radius * Math.cos(turn), f.y[k] + radius * Math.sin(turn), pad);
  }
}
function flightInSpace(scene) {
  const f = data.flight, k = view.moment, T = THREE, at = n => scene.at(f.x[n], f.y[n], f.z[n]);
  scene.line(Array.from({ length: k + 1 }, (_, n) => at(n)), 0x004c8c);
  const ball = (place, colour) => {
    const r = 0.5 * data.lander.radius, shape = new T.CylinderGeometry(r, r, r, 12);
    const mesh = new T.Mesh(shape, new T.MeshLambertMaterial({ color: colour }));
    mesh.position.copy(place); scene.marks.add(mesh);
  };
  for (const [t] of f.decisions) if (t <= momentTime()) ball(at(sampleAt(t)), 0xe69f00);
  for (const [, t] of f.faults) if (t <= momentTime()) ball(at(sampleAt(t)), 0xd55e00);
  const truth = data.layers.find(l => l.name === "truth"), landed = f.down && k === frames.last;
  const ground = (x, y) => truth.values[gridPointAt(x, y)]; // the pads stand on the true ground
  scene.drawLander({ x: f.x[k], y: f.y[k], z: f.z[k] }, landed ? ground : () => f.z[k]);
  const area = f.areas.filter(([t]) => t <= momentTime()).pop();
  if (area && !landed) scene.line(area[1].map(([x, y]) => scene.on(x, y, 0.15)), 0x0072b2, true);
}
