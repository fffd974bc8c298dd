// SPDX-License-Identifier: Apache-2.0
// The layers: values, units, colours, legends.
"use strict";
const UNKNOWN = [205, 205, 205];
const LAYERS = {}; // by name, in the order of the list
const hazardNames = bits =>
  data.hazards.filter(h => bits & h.bit).map(h => h.name).join(", ") || "none";
const isUnknown = h => h.name === UNSEEN.name || h.name === UNMAPPED.name;
const excludes = h => isUnknown(h) || (data.excluding & h.bit);
const centred = "Judged for the lander's centre: a site's circle is the ground it needs, and may " +
  "reach over ground where another landing would fail. ";

function makeLayers() {
  const partly = grid.hazard.some(bits => bits & UNMAPPED.bit);
  const notKnown = partly ? "unseen or not yet mapped" : UNSEEN.name;
  const onGrid = (name, title, unit, values, map, none, more = {}) =>
    (LAYERS[name] = { title, unit, of: "grid", values, limits: values.limits, map, none, ...more });
  const onLeaves = (name, title, unit, values, limits) => (LAYERS[name] =
    { title, unit, of: "fine", at: k => values[fine.leaf[k]], limits, map: "deviation",
      none: "no estimate" });
  for (const layer of data.layers) {
    LAYERS[layer.name] = { ...layer, of: "grid", limits: layer.values.limits, map: layer.kind,
                           none: "not known" };
  }
  if (grid.probability) {
    onGrid("probability", "Probability of a safe touchdown", "%", grid.probability, "probability",
           notKnown, { ofTime: true, note: "If the lander is aimed here, with its dispersion. A site's " +
             "circle is the ground it needs; aiming elsewhere in it may succeed less often." });
  }
  LAYERS.allowed = {
    title: "Where landing is allowed", of: "grid", values: grid.safe, note: centred, ofTime: true,
    value: i => (grid.hazard[i] & UNMAPPED.bit ? 3 : grid.hazard[i] & UNSEEN.bit ? 2 :
      grid.safe[i] ? 0 : 1),
    classes: [
      { name: "allowed", colour: data.colours.safe },
      { name: "excluded", colour: data.colours.excluded }, { ...UNSEEN },
      { ...UNMAPPED },
    ],
  };
  LAYERS.elevation = { title: "Elevation of the map's planes", unit: "m", of: "fine",
    at: k => fine.z[k], limits: limitsOf(fine.z), map: "elevation", none: notKnown };
  const filled = data.hazards.filter(excludes), lines = data.hazards.filter(h => !excludes(h));
  LAYERS.hazards = {
    title: "Hazards by kind", of: "grid", outlines: lines,
    classes: [{ name: "none", colour: data.colours.clear }, ...filled],
    value: i => filled.findIndex(h => grid.hazard[i] & h.bit) + 1,
    note: (data.centred ? centred : "") + (lines.length ? "Outlines do not exclude landing. " : ""),
  };
  onGrid("slope", "Slope at the lander's scale", "deg", grid.slope, "slope", notKnown,
         { mark: grid.slope.mark });
  onGrid("score", "Score, lower is better", "", grid.score, "score", "excluded");
  const sizes = [leaves.max_level, leaves.min_level].map(l => Math.log2(leafSize(l)));
  if (leaves.deviation) {
    onLeaves("deviation", "Deviation of the height, 1 σ", "m", leaves.deviation,
             leaves.deviation.limits);
    onLeaves("roughness", "Roughness (distance from the plane)", "m", leaves.roughness,
             leaves.roughness.limits);
  }
  onLeaves("cells", "Size of the cells (log scale)", "m",
           Float64Array.from(leaves.level, l => Math.log2(leafSize(l))), sizes);
  LAYERS.cells.log = true;
}
function limitsOf(values) { // 1 and 99 %
  const known = Float64Array.from(values).filter(v => !Number.isNaN(v)).sort();
  if (!known.length) return [0, 1];
  const at = share => known[Math.round(share * (known.length - 1))];
  return [at(0.01), Math.max(at(0.99), at(0.01) + 1e-6)];
}
function colour(layer, value) {
  if (Number.isNaN(value) || value === undefined) return UNKNOWN;
  const [low, high] = layer.limits, table = data.maps[layer.map];
  const k = 3 * Math.round(255 * clamp((value - low) / (high - low || 1), 0, 1));
  return [table[k], table[k + 1], table[k + 2]];
}
const painted = {};
function picture(name, k = -1) { // canvas of a layer, of the last answer or the k-th one
  const key = `${name} ${k}`, layer = LAYERS[name];
  if (painted[key]) return painted[key];
  for (const old of Object.keys(painted)) if (!old.endsWith(" -1")) delete painted[old];
  const ofFine = layer.of === "fine", nx = ofFine ? fine.n : grid.nx, ny = ofFine ? nx : grid.ny;
  const canvas = document.createElement("canvas");
  canvas.width = nx; canvas.height = ny;
  const context = canvas.getContext("2d"), image = context.createImageData(nx, ny);
  const colours = layer.classes && layer.classes.map(c => rgb(c.colour));
  const gone = k < 0 ? () => false : ofFine ? i => laterThan(gridUnder(i), k) : i => laterThan(i, k);
  const unseen = rgb(UNSEEN.colour);
  for (let j = 0; j < ny; j++) for (let i = 0; i < nx; i++) {
    const from = j * nx + i, to = 4 * ((ny - 1 - j) * nx + i);
    let c;
    if (gone(from)) c = colours ? unseen : UNKNOWN;
    else if (name === "allowed" && k >= 0) c = colours[allowedAt(from, k) ? 0 : 1];
    else if (name === "probability" && k >= 0) c = colour(layer, probabilityAt(from, k));
    else if (colours) c = colours[layer.value ? layer.value(from) : layer.values[from]];
    else c = colour(layer, ofFine ? layer.at(from) : layer.values[from]);
    image.data[to] = c[0]; image.data[to + 1] = c[1]; image.data[to + 2] = c[2];
    image.data[to + 3] = 255;
  }
  context.putImageData(image, 0, 0);
  const half = grid.spacing / 2;
  const box = ofFine ? [leaves.xmin, leaves.ymin, leaves.size, leaves.size] :
    [grid.xmin - half, grid.ymin - half, nx * grid.spacing, ny * grid.spacing];
  return (painted[key] = { canvas, box });
}
function gridUnder(k) {
  return gridPointAt(leaves.xmin + (k % fine.n + 0.5) * fine.size,
                     leaves.ymin + (Math.floor(k / fine.n) + 0.5) * fine.size);
}
let relief = null;
function reliefPicture(k = -1) { // of what was seen by the k-th answer, or at last
  if (relief && relief.k === k) return relief;
  const canvas = document.createElement("canvas"), n = canvas.width = canvas.height = fine.n;
  const context = canvas.getContext("2d"), image = context.createImageData(n, n);
  for (let j = 0; j < n; j++) for (let i = 0; i < n; i++) {
    const to = 4 * ((n - 1 - j) * n + i);
    const from = j * n + i, gone = k >= 0 && laterThan(gridUnder(from), k);
    image.data.fill(gone ? 128 : fine.shade[from], to, to + 3);
    image.data[to + 3] = 255;
  }
  context.putImageData(image, 0, 0);
  return (relief = { k, canvas, box: [leaves.xmin, leaves.ymin, leaves.size, leaves.size] });
}

// ---- legend ------------------------------------------------------------------------------------
function legend() {
  const layer = LAYERS[view.layer], box = byId("legend");
  const note = (layer.note || "") + (view.answer < 0 || layer.ofTime ? "" :
    " Ground seen by the shown time, with its values at the end.");
  const swatch = (style, name, value) =>
    `<span class="key"><i style="${style}"></i>${name}<b>${value}</b></span>`;
  if (layer.classes) {
    const counts = new Array(layer.classes.length).fill(0), { nx, ny } = grid;
    for (let j = 0; j < ny; j++) for (let i = 0; i < nx; i++) { // at the edge, half a cell
      const weight = (i % (nx - 1) ? 1 : 0.5) * (j % (ny - 1) ? 1 : 0.5), k = j * nx + i;
      counts[layer.ofTime && view.answer >= 0 ? allowedClass(k, view.answer) :
        layer.value ? layer.value(k) : layer.values[k]] += weight;
    }
    const seen = counts.reduce((sum, c, i) =>
      sum + (isUnknown(layer.classes[i]) ? 0 : c), 0);
    const each = grid.spacing ** 2;
    const share = (k, i) => (isUnknown(k) ? `${Math.round(counts[i] * each)} m²` :
      `${(100 * counts[i] / (seen || 1)).toFixed(1)} % · ${Math.round(counts[i] * each)} m²`);
    box.innerHTML = layer.classes.map((k, i) =>
      (counts[i] ? swatch(`background:${k.colour}`, k.name, share(k, i)) : "")).join("") +
      (layer.outlines || []).map(k =>
        swatch(`border:2px solid ${k.colour}`, k.name, "outline")).join("") +
      `<p class="note">${note} Shares are of the seen ground.</p>`;
    return;
  }
  box.innerHTML = "<canvas></canvas>" + swatch(`background:rgb(${UNKNOWN})`, layer.none, "") +
    (note ? `<p class="note">${note}</p>` : "");
  const canvas = box.firstChild, c = fitCanvas(canvas), w = canvas.clientWidth - 24;
  const [low, high] = layer.limits;
  for (let p = 0; p < w; p++) {
    c.fillStyle = `rgb(${colour(layer, low + (high - low) * p / (w - 1))})`;
    c.fillRect(12 + p, 0, 1.5, 14);
  }
  c.fillStyle = ink("--ink"); c.font = "11px system-ui, sans-serif"; c.textBaseline = "top";
  const marks = ticks(layer);
  marks.forEach((v, i) => {
    const p = 12 + w * (v - low) / (high - low || 1);
    const unit = i === marks.length - 1 && layer.unit ? " " + layer.unit : "";
    const text = (layer.log ? short(2 ** v) : short(v)) + unit, half = c.measureText(text).width / 2;
    c.fillRect(p - 0.5, 14, 1, 4);
    c.textAlign = "center";
    c.fillText(text, clamp(p, half, w + 24 - half), 20);
  });
}
function ticks(layer) { // round numbers; of sizes, powers of two
  const [low, high] = layer.limits;
  if (layer.mark !== undefined) {
    return layer.mark < 0.93 * high ? [low, layer.mark, high] : [low, high];
  }
  const step = layer.log ? Math.ceil((high - low) / 6) || 1 : nice((high - low) / 4);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) {
    found.push(k * step);
  }
  return found.length > 1 ? found : [low, high];
}
