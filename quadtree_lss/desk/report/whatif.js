// SPDX-License-Identifier: Apache-2.0
// What if: allowed ground and sites for another vehicle, dispersion, risk or margin, as a landing pass has them.
"use strict";
const SLACK = 1e-6, TIE = 1e-5; // columns of single precision; see score.py and grid.py
function blurred(values, n, sigma) { // along the rows of (n, n), turned over: rows become columns
  const reach = Math.ceil(4 * sigma / whatIf.side), out = new Float64Array(n * n);
  const weights = Array.from({ length: 2 * reach + 1 }, (_, k) =>
    (sigma ? Math.exp(-0.5 * (Math.min(Math.abs(k - reach) * whatIf.side / sigma, 40)) ** 2) : 1));
  const sum = weights.reduce((a, b) => a + b, 0);
  for (let j = 0; j < n; j++) for (let i = 0; i < n; i++) {
    let total = 0;
    const from = Math.max(i - reach, 0), to = Math.min(i + reach, n - 1);
    for (let k = from; k <= to; k++) total += values[j * n + k] * weights[k - i + reach];
    out[i * n + j] = total / sum;
  }
  return out;
}
function allowedFor(vehicle, maxRisk, margin) { // 1 for each point of the lattice that the ground allows
  const { n, side } = whatIf, { risk, room, judged, excepted } = vehicle, out = new Uint8Array(n * n).fill(1);
  const reach = margin / side * (1 + 1e-9), ring = [];
  for (let v = -Math.floor(reach); v <= reach; v++) for (let u = -Math.floor(reach); u <= reach; u++) {
    if (Math.hypot(u, v) <= reach) ring.push([u, v]);
  }
  const zone = (1 - SLACK) * (vehicle.diameter / 2 + margin);
  for (let j = 0; j < n; j++) for (let i = 0; i < n; i++) {
    const k = j * n + i;
    if (room[k] < zone) out[k] = 0;
    if (!judged[k] || !(risk[k] > maxRisk || excepted[k])) continue;
    for (const [u, v] of ring) {
      if (i + u >= 0 && i + u < n && j + v >= 0 && j + v < n) out[k + v * n + u] = 0;
    }
  }
  return out;
}
function corners(x, low) { // the lattice points on either side of a grid point, and the share of the far one
  const at = clamp((x - low) / whatIf.side, 0, whatIf.n - 1), near = Math.floor(at + 1e-6);
  return [near, Math.ceil(at - 1e-6), clamp(at - near, 0, 1)];
}
const vehicleOf = ({ diameter, clearance }) =>
  whatIf.vehicles.find(v => v.diameter === diameter && v.clearance === clearance);
function recompute(values) { // allowed, probability, best sites
  const { n, number } = whatIf, { dispersion: [sx, sy], max_risk: maxRisk, margin } = values;
  const vehicle = vehicleOf(values), { risk, extra, separation } = vehicle;
  const likely = blurred(blurred(Float64Array.from(risk, r => 1 - r), n, sx), n, sy);
  const can = allowedFor(vehicle, maxRisk, margin), all = grid.nx * grid.ny;
  const allowed = new Uint8Array(all), probability = new Float64Array(all), cost = new Float64Array(all);
  for (let j = 0; j < grid.ny; j++) {
    const [south, north, v] = corners(grid.ymin + j * grid.spacing, leaves.ymin);
    for (let i = 0; i < grid.nx; i++) {
      const [west, east, u] = corners(grid.xmin + i * grid.spacing, leaves.xmin), k = j * grid.nx + i;
      const [a, b, c, d] = [[south, west], [south, east], [north, west], [north, east]].map(
        ([row, column]) => row * n + column);
      allowed[k] = can[a] & can[b] & can[c] & can[d];
      probability[k] = (1 - v) * ((1 - u) * likely[a] + u * likely[b]) +
        v * ((1 - u) * likely[c] + u * likely[d]);
      const score = Number.isNaN(grid.score[k]) ? whatIf.score[k] : grid.score[k];
      const s = score / (1 + Math.abs(score)) || 0;
      cost[k] = allowed[k] ? 1 - probability[k] + 0.5 * TIE * s + extra[k] : NaN;
    }
  }
  const found = [], left = cost.slice();
  while (found.length < number) {
    let k = -1;
    for (let i = 0; i < all; i++) if (left[i] < (k < 0 ? Infinity : left[k])) k = i;
    if (k < 0) break;
    const row = Math.floor(k / grid.nx), column = k % grid.nx, s = grid.spacing;
    for (let i = 0; i < all; i++) {
      const away = Math.hypot(Math.floor(i / grid.nx) - row, i % grid.nx - column) * s;
      if (away < separation * (1 - 1e-9) || i === k) left[i] = NaN;
    }
    const x = grid.xmin + column * s, y = grid.ymin + row * s;
    found.push({ rank: found.length + 1, x, y, z: heightAt(x, y), probability: probability[k],
                 reason: "what if, not the run's own result" });
  }
  return { allowed, probability, found };
}
let whatIf = null;
function tried(values) { // shows another result; null, the run's own
  own.grid = own.grid || { safe: grid.safe.slice(), probability: grid.probability.slice(), sites: [...sites],
                           zone: data.zone, radius: data.lander.radius, doubted: data.trust.doubted };
  if (values && view.answer >= 0) setInstant(data.history.seconds.length - 1);
  own.tried = values;
  root.classList.toggle("what-if", values !== null);
  const now = values ? recompute(values) : { allowed: own.grid.safe, found: own.grid.sites };
  grid.safe.set(now.allowed);
  const vehicle = values && vehicleOf(values);
  data.zone = values ? vehicle.diameter / 2 + values.margin : own.grid.zone;
  data.lander.radius = values ? vehicle.diameter / 2 : own.grid.radius;
  data.trust.doubted = own.grid.doubted || Boolean(values && vehicle.doubt);
  if (values) now.probability.forEach((p, i) => {
    grid.probability[i] = grid.hazard[i] & UNSEEN.bit ? NaN : 100 * p; });
  else grid.probability.set(own.grid.probability);
  sites.splice(0, sites.length, ...now.found);
  for (const name of ["allowed -1", "probability -1"]) delete painted[name];
  delete outlines["allowed -1"];
  if (values) {
    const best = sites[0];
    headlineOf(...answerOf(sites.length, best ? best.probability : null),
               allowedGround(LAYERS.allowed.value), "What if, not the run's own result. ");
    tableOf(sites.map((s, k) => [k, s.x, s.y, s.z, null, s.probability]), -1, true);
  } else { headlineOf(""); tableOf(null); }
  rows(); legend(); choose(sites.length ? 0 : -1, false);
}
function sliders() {
  const box = byId("what-if"), note = byId("what-if-note");
  if (!data.what_if || !box) return;
  if (data.what_if.why) { note.textContent = `Not here: ${data.what_if.why}.`; return; }
  whatIf = data.what_if;
  for (const v of whatIf.vehicles) {
    v.risk = v.risk || Float64Array.from(v.about, to => Math.max(10 ** to - whatIf.small, 0));
  }
  const [first] = whatIf.vehicles, { diameter, clearance } = first;
  const set = { dispersion: [...whatIf.dispersion], max_risk: whatIf.max_risk, margin: whatIf.own_margin,
                diameter, clearance };
  const percent = v => `${short(100 * v)} %`, metres = v => `${short(v)} m`;
  const slider = (name, words, low, high, value, tell, of = v => v, step = "any") => {
    const row = box.querySelector(".tries").appendChild(document.createElement("label"));
    row.innerHTML = `<span>${words}</span><input type="range" min="${low}" max="${high}" step="${step}" ` +
      `value="${value}" id="try-${name}"><output>${tell(of(value))}</output>`;
    row.children[1].oninput = e => { row.lastChild.textContent = tell(of(Number(e.target.value))); };
    row.children[1].onchange = e => {
      const v = of(Number(e.target.value));
      set[name] = name === "dispersion" ? [v, v] : v;
      tried({ ...set });
      tellRun();
    };
  };
  const tellRun = () => {
    const given = Object.entries(set).filter(([k, w]) => first[k] !== w).map(([k, w]) =>
      `--set ${k in first ? "vehicle" : "lss"}.${k}=${parseFloat((k === "dispersion" ? w[0] : w).toPrecision(3))}`);
    byId("what-if-run").textContent =
      `quadtree-lss ${whatIf.run} ${whatIf.bag} --config config.yaml ${given.join(" ")}`;
    const { doubt } = vehicleOf(set);
    byId("what-if-doubt").textContent = doubt && `With care: ${doubt}.`;
  };
  const widest = Math.max(diameter, 2 * Math.max(...set.dispersion));
  slider("dispersion", "dispersion, 1 σ", 0, widest, set.dispersion[0], metres);
  slider("max_risk", "risk allowed at a place", -5, 0, Math.log10(clamp(set.max_risk, 1e-5, 1)), percent,
         v => 10 ** v);
  if (whatIf.margin !== null) slider("margin", "margin", 0, Math.max(diameter, 2 * set.margin), set.margin, metres);
  for (const [name, words] of [["diameter", "vehicle's diameter"], ["clearance", "vehicle's clearance"]]) {
    const all = [...new Set(whatIf.vehicles.map(v => v[name]))].sort((a, b) => a - b);
    slider(name, words, 0, all.length - 1, all.indexOf(first[name]), metres, k => all[k], 1);
  }
  tellRun();
  byId("what-if-reset").onclick = () => { box.querySelector(".tries").textContent = ""; tried(null); sliders(); };
}
