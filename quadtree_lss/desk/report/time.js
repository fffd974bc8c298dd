// SPDX-License-Identifier: Apache-2.0
// The flight over time: the map growing, sites and target, what became of each.
"use strict";
const allowedAt = (i, k) => {
  const row = Math.ceil(grid.nx * grid.ny / 8);
  return data.history.allowed[k * row + (i >> 3)] >> (7 - (i & 7)) & 1;
};
const allowedClass = (i, k) => (laterThan(i, k) ? 2 : allowedAt(i, k) ? 0 : 1);
const probabilityAt = (i, k) => { // per cent
  const found = data.history.probability;
  if (!found) return grid.probability[i];
  const v = found[k * grid.nx * grid.ny + i];
  return v === 255 ? NaN : v;
};
const laterThan = (i, k) => { // whether the ground was not known by the k-th answer
  const row = Math.ceil(grid.nx * grid.ny / 8);
  return i < 0 || !(data.history.seen[k * row + (i >> 3)] >> (7 - (i & 7)) & 1);
};
let playing = 0;
function setInstant(k) { // of the answers; the last one is the map as it lies
  const h = data.history, last = h.seconds.length - 1;
  view.answer = k >= last ? -1 : k;
  const at = Math.min(k, last), found = h.sites[at].length;
  if (!data.flight) byId("instant").value = at;
  byId("clock").textContent = `${h.seconds[at].toFixed(1)} s · ${found || "no"} site` +
    (found === 1 ? "" : "s");
  tableOfTheTime(); legend();
  for (const chart of charts_sites) { chart.redraw(false); tellThen(chart); }
  if (space) space.update();
  draw();
}
const tellThen = chart => setTimeout(() => // when the chart has forgotten the pointer
  chart.setLegend({ idx: view.answer < 0 ? data.history.seconds.length - 1 : view.answer }));
const own = {}; // the run's own headline and rows of the table
function headlineOf(level, words, ground) { // as `headline` of headline.py has it; without a level, the run's own
  const box = byId("verdict"), [answer, text] = box.children;
  own.verdict = own.verdict || [box.className, answer.textContent, text.textContent];
  [box.className, answer.textContent, text.textContent] = level ?
    [`verdict ${level}`, `At ${data.history.seconds[view.answer].toFixed(1)} s. ${words}.`, ground] : own.verdict;
}
function answerOf(number, share) { // level and words for so many sites, the best of that probability
  const { words, good, least, doubted } = data.trust;
  if (!number) return ["none", "No landing site"];
  if (share === null) return ["care", `${words.care}: no probability is computed`];
  const level = share < least ? "none" : share >= good && !doubted ? "good" : "care";
  return [level, `${words[level]}: ${shareText(100 * share)} % at ` +
    (number > 1 ? `the best of ${number} sites` : "the one site")];
}
function allowedGround(k) { // of the k-th answer
  const found = [0, 0, 0]; // allowed, excluded, unknown
  for (let i = 0; i < grid.nx * grid.ny; i++) found[allowedClass(i, k)]++;
  const seen = found[0] + found[1], each = grid.spacing ** 2;
  return `Landing is allowed on ${few(100 * found[0] / (seen || 1))} % of the ` +
    `${few(seen * each)} m² seen: ${few(found[0] * each)} m².`;
}
function tableOf(found, target) { // [id, x, y, z, score, probability] of each; null: the run's own
  const table = byId("sites");
  if (!table) return;
  const body = table.tBodies[0];
  own.rows = own.rows || body.innerHTML;
  table.classList.toggle("part", found !== null);
  const wide = table.tHead.rows[0].cells.length;
  body.innerHTML = found === null ? own.rows : found.map(([id, x, y, z, score, share], row) => {
    const cells = [x, y, z].map(v => (v === null ? "–" : v.toFixed(2)));
    if (grid.probability) cells.push(share === null ? "–" : shareText(100 * share));
    cells.push(score === null ? "–" : score.toFixed(3));
    while (cells.length < wide - 1) cells.push("");
    return `<tr${id === target ? ' class="chosen"' : ""}><th>${row + 1}</th>` +
      cells.map(c => `<td>${c}</td>`).join("") + "</tr>";
  }).join("");
}
function tableOfTheTime() { // what is kept of the shown answer; at the end, all
  const k = view.answer, h = data.history, table = byId("sites");
  if (k < 0) {
    if (!own.past) return;
    own.past = false;
    headlineOf(""); tableOf(null); rows(); tellSite(view.site);
    return;
  }
  own.past = true;
  const [target] = h.targets[k];
  const best = h.sites[k][0];
  headlineOf(...answerOf(h.sites[k].length, best ? best[5] : null), allowedGround(k));
  if (!table) return;
  tableOf(h.sites[k], target);
  byId("why").innerHTML = `<b>At ${h.seconds[k].toFixed(1)} s</b>: `;
  byId("why").append(h.why[k]);
}
const charts_sites = [], FRAME_MS = 250; // between two frames that play
// What the slider goes over: the answers, or the samples of a flight.
const frames = { last: 0, step: 1, go: k => setInstant(k), ofAnswer: k => k,
                 at: () => (view.answer < 0 ? frames.last : view.answer) };
function player() {
  const slider = byId("instant");
  slider.max = frames.last;
  slider.oninput = () => frames.go(Number(slider.value));
  byId("play").onclick = () => {
    if (playing) { clearTimeout(playing); playing = 0; }
    else {
      if (frames.at() >= frames.last) frames.go(0);
      const next = () => {
        frames.go(Math.min(frames.at() + frames.step, frames.last));
        if (frames.at() >= frames.last) byId("play").onclick();
        else playing = setTimeout(next, FRAME_MS);
      };
      playing = setTimeout(next, FRAME_MS);
    }
    byId("play").textContent = playing ? "❚❚" : "▶";
  };
}
function timeline() {
  const h = data.history;
  if (!h) { byId("show-track").parentElement.hidden = true; return; }
  byId("time").hidden = false;
  const last = frames.last = h.seconds.length - 1;
  player();
  const counts = new Map();
  for (const all of h.sites) for (const [id] of all) counts.set(id, (counts.get(id) || 0) + 1);
  const rank = id => (sites.find(s => s.id === id) || {}).rank;
  const ids = [...counts.keys()].sort((a, b) => (rank(a) || 99) - (rank(b) || 99) ||
    counts.get(b) - counts.get(a)).slice(0, 7);
  const name = id => (rank(id) ? `site ${rank(id)}` : `former ${id}`);
  const mark = u => { // the shown instant
    const t = h.seconds[view.answer < 0 ? last : view.answer], c = u.ctx;
    const p = u.valToPos(t, "x", true);
    c.save(); c.strokeStyle = ink("--ink"); c.lineWidth = devicePixelRatio; c.beginPath();
    c.moveTo(p, u.bbox.top); c.lineTo(p, u.bbox.top + u.bbox.height); c.stroke(); c.restore();
  };
  const range = (u, low, high) => { // at least 1 %, so that a steady value looks steady
    if (low === null) return [0, 1];
    const middle = (low + high) / 2, half = Math.max(0.55 * (high - low), 0.5);
    const top = Math.min(middle + half, 100);
    return [Math.min(middle - half, top - 1), top];
  };
  const ends = data.flight && [0, data.flight.time.length - 1].map(k => data.flight.time[k] - data.flight.before);
  if (h.sites.some(all => all.some(s => s[5] !== null))) {
    const lines = ids.map(id => h.sites.map(all => {
      const row = all.find(s => s[0] === id);
      return row && row[5] !== null ? 100 * row[5] : null;
    }));
    const told = (u, v) => (v === null ? "–" : shareText(v) + " %");
    charts_sites.push(plot(byId("chart-sites"), 130, {
      series: [{ label: "time", value: second_s }, ...ids.map((id, k) =>
        curve(name(id), CURVES[k], "", { value: told, width: rank(id) ? 2 : 1, spanGaps: false,
          points: { show: true, size: 3 } }))],
      scales: { x: { time: false, ...(ends && { range: () => ends }) }, y: { range } },
      axes: [{ label: "time, s" }, { label: "probability, %" }],
      hooks: { draw: [mark] },
      cursor: {
        bind: { mousedown: u => () => { frames.go(frames.ofAnswer(u.cursor.idx)); return null; } } },
    }, [h.seconds, ...lines]));
  }
  for (const chart of charts_sites) { // away from the curves, the values of the shown time
    chart.over.addEventListener("mouseleave", () => tellThen(chart));
  }
  setInstant(last);
}
