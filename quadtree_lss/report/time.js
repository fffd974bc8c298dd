// SPDX-License-Identifier: Apache-2.0
// The flight over time: the map growing, sites and target, what became of each.
"use strict";
const allowedAt = (i, k) => {
  const row = Math.ceil(grid.nx * grid.ny / 8);
  return data.history.allowed[k * row + (i >> 3)] >> (7 - (i & 7)) & 1;
};
const laterThan = (i, k) => i < 0 || data.history.since[i] > k;
let playing = 0;
function setInstant(k) { // of the answers; the last one is the map as it lies
  const h = data.history, last = h.seconds.length - 1;
  view.answer = k >= last ? -1 : k;
  byId("instant").value = Math.min(k, last);
  const found = h.sites[Math.min(k, last)].length;
  byId("clock").textContent = `${h.seconds[Math.min(k, last)].toFixed(1)} s · ${found || "no"} site` +
    (found === 1 ? "" : "s");
  for (const chart of charts_sites) chart.redraw(false);
  if (space) space.update();
  draw();
}
const charts_sites = [];
function timeline() {
  const h = data.history;
  if (!h) { byId("show-track").parentElement.hidden = true; return; }
  byId("time").hidden = false;
  const slider = byId("instant"), last = h.seconds.length - 1;
  slider.max = last;
  slider.oninput = () => setInstant(Number(slider.value));
  byId("play").onclick = () => {
    if (playing) { clearInterval(playing); playing = 0; }
    else {
      if (view.answer < 0) setInstant(0);
      playing = setInterval(() => {
        setInstant(Number(slider.value) + 1);
        if (view.answer < 0) byId("play").onclick();
      }, 250);
    }
    byId("play").textContent = playing ? "❚❚" : "▶";
  };
  const counts = new Map();
  for (const all of h.sites) for (const [id] of all) counts.set(id, (counts.get(id) || 0) + 1);
  const final = new Set(sites.map(s => s.id));
  const ids = [...counts.keys()].sort((a, b) => final.has(b) - final.has(a) ||
    counts.get(b) - counts.get(a)).slice(0, 7);
  const rank = id => (sites.find(s => s.id === id) || {}).rank;
  const name = id => (rank(id) ? `site ${rank(id)}` : `place ${id}`);
  const mark = u => { // the shown instant
    const t = h.seconds[view.answer < 0 ? last : view.answer], c = u.ctx;
    const p = u.valToPos(t, "x", true);
    c.save(); c.strokeStyle = ink("--ink"); c.lineWidth = devicePixelRatio; c.beginPath();
    c.moveTo(p, u.bbox.top); c.lineTo(p, u.bbox.top + u.bbox.height); c.stroke(); c.restore();
  };
  const chart = (column, scale, label, unit) => {
    if (!h.sites.some(all => all.some(s => s[column] !== null))) return;
    const lines = ids.map(id => h.sites.map(all => {
      const row = all.find(s => s[0] === id);
      return row && row[column] !== null ? scale * row[column] : null;
    }));
    charts_sites.push(plot(byId("chart-sites"), 130, {
      series: [{ label: "time", value: second_s }, ...ids.map((id, k) =>
        curve(name(id), CURVES[k], unit, { width: rank(id) ? 2 : 1, spanGaps: false,
          points: { show: true, size: 3 } }))],
      scales: { x: { time: false } }, axes: [{ label: "time, s" }, { label }],
      hooks: { draw: [mark] }, legend: { show: !charts_sites.length },
      cursor: { sync: { key: "sites" },
        bind: { mousedown: u => () => { setInstant(u.cursor.idx); return null; } } },
    }, [h.seconds, ...lines]));
  };
  chart(5, 100, "safe with, %", " %");
  chart(4, 1, "score", "");
  setInstant(last);
}
