// SPDX-License-Identifier: Apache-2.0
// Each flight of a campaign as a point of any two quantities; a click shows its figures and the command that keeps it.
"use strict";
const { columns, indices, seeds, groups, colours, titles, command } = data;
const canvas = byId("scatter");
const chosen = { x: "", y: "", flight: -1 };
const EDGE = { left: 56, right: 14, top: 10, bottom: 40 };
const known = name => Array.from(columns[name]).filter(v => !Number.isNaN(v));
function scaleOf(name, from, to) { // from values to pixels, with a margin at both ends
  const all = known(name), low = Math.min(...all), high = Math.max(...all);
  const room = 0.04 * (high - low) || 0.5, a = low - room, b = high + room;
  return { low: a, high: b, at: v => from + (v - a) / (b - a) * (to - from) };
}
function scales() {
  const w = canvas.clientWidth, h = canvas.clientHeight;
  return [scaleOf(chosen.x, EDGE.left, w - EDGE.right), scaleOf(chosen.y, h - EDGE.bottom, EDGE.top)];
}
function places() { // position of each flight on the canvas, or null without both quantities
  const [sx, sy] = scales();
  return indices.map((_, k) => {
    const x = columns[chosen.x][k], y = columns[chosen.y][k];
    return Number.isNaN(x) || Number.isNaN(y) ? null : [sx.at(x), sy.at(y)];
  });
}
function drawScatter() {
  const ratio = devicePixelRatio || 1, w = canvas.clientWidth, h = canvas.clientHeight;
  canvas.width = w * ratio; canvas.height = h * ratio;
  const c = canvas.getContext("2d"), [sx, sy] = scales();
  c.setTransform(ratio, 0, 0, ratio, 0, 0);
  c.font = "11px system-ui, sans-serif"; c.fillStyle = ink("--soft-ink"); c.strokeStyle = ink("--line");
  const ticks = (s, count, put) => {
    const step = nice((s.high - s.low) / count);
    for (let v = Math.ceil(s.low / step) * step; v <= s.high; v += step) put(s.at(v), plain(v, step));
  };
  c.textAlign = "center";
  ticks(sx, 8, (p, text) => {
    c.strokeRect(p, EDGE.top, 0, h - EDGE.bottom - EDGE.top); c.fillText(text, p, h - EDGE.bottom + 14); });
  c.fillText(titles[chosen.x], (EDGE.left + w) / 2, h - 8);
  c.textAlign = "right";
  ticks(sy, 6, (p, text) => {
    c.strokeRect(EDGE.left, p, w - EDGE.left - EDGE.right, 0); c.fillText(text, EDGE.left - 5, p + 4); });
  c.save(); c.translate(12, h / 2); c.rotate(-Math.PI / 2); c.textAlign = "center";
  c.fillText(titles[chosen.y], 0, 0); c.restore();
  places().forEach((at, k) => {
    if (!at) return;
    const own = indices[k] === chosen.flight;
    c.beginPath(); c.arc(...at, own ? 8 : 5, 0, 7);
    c.globalAlpha = own ? 1 : 0.7; c.fillStyle = colours[groups[k] % colours.length]; c.fill(); c.globalAlpha = 1;
    if (own || data.bad[k]) {
      c.strokeStyle = ink(own ? "--ink" : "--bad"); c.lineWidth = 2.5; c.stroke(); c.lineWidth = 1;
    }
  });
}
function pickFlight(index) { // show its figures and the command that flies it again
  const k = indices.indexOf(index), box = byId("flight");
  box.textContent = "";
  if (k < 0) { box.textContent = "There is no such flight."; return; }
  chosen.flight = index;
  byId("number").value = index;
  const head = box.appendChild(document.createElement("p"));
  head.append(`Flight ${index}, seed ${seeds[k]}: `);
  head.appendChild(document.createElement("code")).textContent = `${command} ${index}`;
  const table = box.appendChild(document.createElement("table"));
  table.className = "plain";
  for (const name of Object.keys(titles)) {
    const row = table.insertRow();
    row.insertCell().textContent = titles[name];
    row.insertCell().textContent = short(columns[name][k]);
  }
  try { history.replaceState(null, "", `#x=${chosen.x}&y=${chosen.y}&flight=${index}`); }
  catch (refused) { /* some browsers forbid this for files */ }
  drawScatter();
}
async function startCampaign() {
  unpackAll(await inflate(byId("columns").textContent), data);
  for (const name of Object.keys(titles)) if (!known(name).length) delete titles[name];
  const names = Object.keys(titles), words = new URLSearchParams(location.hash.slice(1));
  for (const [axis, first] of [["x", data.first[0]], ["y", data.first[1]]]) {
    const select = byId(`axis-${axis}`), wanted = words.get(axis);
    select.innerHTML = "";
    for (const name of names) select.add(new Option(titles[name], name));
    chosen[axis] = select.value = names.includes(wanted) ? wanted : names.includes(first) ? first : names[0];
    select.onchange = () => { chosen[axis] = select.value; drawScatter(); };
  }
  canvas.onclick = e => {
    const near = places().map((at, k) => [at ? Math.hypot(at[0] - e.offsetX, at[1] - e.offsetY) : Infinity, k])
      .reduce((a, b) => (b[0] < a[0] ? b : a));
    if (near[0] < 14) pickFlight(indices[near[1]]);
  };
  byId("number").onchange = e => pickFlight(Number(e.target.value));
  for (const button of document.querySelectorAll("button[data-flight]")) {
    button.onclick = () => { pickFlight(Number(button.dataset.flight)); canvas.scrollIntoView({ block: "center" }); };
  }
  new ResizeObserver(drawScatter).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", drawScatter);
  if (words.has("flight")) pickFlight(Number(words.get("flight")));
  drawScatter();
  root.dataset.ready = "yes";
}
startCampaign();
