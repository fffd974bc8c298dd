// SPDX-License-Identifier: Apache-2.0
// The flight over time: the map growing, sites and target, what became of each.
"use strict";
const allowedAt = (i, k) => {
  const row = Math.ceil(grid.nx * grid.ny / 8);
  return data.history.allowed[k * row + (i >> 3)] >> (7 - (i & 7)) & 1;
};
const riskAt = (i, k) => { // decimal logarithm, as of history.py; NaN without it
  const found = data.history.risk, v = found ? found[k * grid.nx * grid.ny + i] : 255;
  return v === 255 ? NaN : -v / 60;
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
  tellMoment(); legend();
  if (space) space.update();
  draw();
}
const own = {}; // rows of the table at the end
function showVerdict({ level, answer, ground, facts }) { // of `verdict` in headline.py
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
function tableOf(found, target) { // [id, x, y, z, score, probability] of each; null: at the end
  const table = byId("sites");
  if (!table) return;
  const body = table.tBodies[0];
  own.rows = own.rows || body.innerHTML;
  table.classList.toggle("part", found !== null);
  body.innerHTML = found === null ? own.rows : found.map(([id, x, y, , score, share], row) => {
    const cells = [x, y].map(v => v.toFixed(2));
    cells.push(share === null ? short(score) : shareText(100 * share));
    return `<tr${id === target ? ' class="chosen"' : ""}><th>${row + 1}</th>` +
      cells.map(c => `<td>${c}</td>`).join("") + "</tr>";
  }).join("");
}
function tellMoment() { // headline, facts and table of the shown assessment
  const k = view.answer, h = data.history;
  if (k < 0) {
    if (!own.past) return;
    own.past = false;
    showVerdict(data.verdict); tableOf(null); rows(); tellSite(view.site);
    return;
  }
  own.past = true;
  const [target] = h.targets[k], then = h.verdicts[k];
  showVerdict({ ...then, answer: `At ${h.seconds[k].toFixed(1)} s. ${then.answer}` });
  tableOf(h.sites[k], target);
  byId("why").textContent = `At ${h.seconds[k].toFixed(1)} s: ${h.why[k]}`;
}
const FRAME_MS = 250; // between two frames that play
// What the slider goes over: the answers, or the samples of a flight.
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
        else playing = setTimeout(next, FRAME_MS);
      };
      playing = setTimeout(next, FRAME_MS);
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
