// SPDX-License-Identifier: Apache-2.0
// The map, its sites and the target over time.
"use strict";
const allowedAt = (i, k) => {
  const row = Math.ceil(grid.nx * grid.ny / 8);
  return data.history.allowed[k * row + (i >> 3)] >> (7 - (i & 7)) & 1;
};
const riskAt = (i, k) => { // decimal logarithm (encoding of history.py); NaN if unknown
  const found = data.history.risk, v = found ? found[k * grid.nx * grid.ny + i] : 255;
  return v === 255 ? NaN : -v / 60;
};
const isUnobservedAt = (i, k) => { // whether assessment k did not know the ground
  const row = Math.ceil(grid.nx * grid.ny / 8);
  return i < 0 || !(data.history.seen[k * row + (i >> 3)] >> (7 - (i & 7)) & 1);
};
let playing = 0;
function setInstant(k) { // show assessment k
  const h = data.history, last = h.seconds.length - 1;
  view.answer = k >= last ? -1 : k;
  const at = Math.min(k, last), found = h.sites[at].length;
  if (!data.flight) byId("instant").value = at;
  byId("clock").textContent = `${h.seconds[at].toFixed(1)} s · ${found || "no"} site` +
    (found === 1 ? "" : "s");
  showAssessment(); legend();
  if (space) space.update();
  draw();
}
const tableState = {}; // rows of the last assessment; whether an earlier one is shown
function showVerdict({ level, answer, ground, facts }) { // see `Verdict` in headline.py
  byId("verdict").className = `verdict ${level}`;
  byId("verdict").innerHTML = "<b></b> <span></span>";
  byId("verdict").children[0].textContent = answer;
  byId("verdict").children[1].textContent = ground;
  byId("facts").innerHTML = "";
  for (const [name, value, of] of facts) {
    const fact = byId("facts").appendChild(document.createElement("div"));
    fact.className = of;
    fact.append(Object.assign(document.createElement("dt"), { textContent: name }),
                Object.assign(document.createElement("dd"), { textContent: value }));
  }
}
function showTable(found, target) { // rows [id, x, y, z, score, probability]; null: the last assessment
  const table = byId("sites");
  if (!table) return;
  const body = table.tBodies[0];
  tableState.rows = tableState.rows || body.innerHTML;
  table.classList.toggle("part", found !== null);
  body.innerHTML = found === null ? tableState.rows : found.map(([id, x, y, , score, share], row) => {
    const cells = [x, y].map(v => v.toFixed(2));
    cells.push(share === null ? short(score) : shareText(100 * share));
    return `<tr${id === target ? ' class="chosen"' : ""}><th>${row + 1}</th>` +
      cells.map(c => `<td>${c}</td>`).join("") + "</tr>";
  }).join("");
}
function showAssessment() { // headline, facts and table
  const k = view.answer, h = data.history;
  if (k < 0) {
    if (!tableState.past) return;
    tableState.past = false;
    showVerdict(data.verdict); showTable(null); connectRows(); showSiteReason(view.site);
    return;
  }
  tableState.past = true;
  const [target] = h.targets[k], then = h.verdicts[k];
  showVerdict({ ...then, answer: `At ${h.seconds[k].toFixed(1)} s. ${then.answer}` });
  showTable(h.sites[k], target);
  byId("why").textContent = `At ${h.seconds[k].toFixed(1)} s: ${h.why[k]}`;
}
const FRAME_PERIOD_MS = 250; // of playing
// The steps of the slider: assessments, or samples of a flight.
const frames = { last: 0, step: 1, go: k => setInstant(k),
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
        else playing = setTimeout(next, FRAME_PERIOD_MS);
      };
      playing = setTimeout(next, FRAME_PERIOD_MS);
    }
    byId("play").textContent = playing ? "❚❚" : "▶";
  };
}
function timeline() {
  if (!data.history) { byId("show-track").parentElement.hidden = true; return; }
  byId("time").hidden = false;
  frames.last = data.history.seconds.length - 1;
  player();
  setInstant(frames.last);
}
