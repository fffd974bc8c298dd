// SPDX-License-Identifier: Apache-2.0
// Layers: values, units, colours, legends.
"use strict";
const UNKNOWN = [195, 212, 238], LANDING = "landing";
const LAYERS = {}; // by name, in the order of the list
const hazardNames = bits =>
  data.hazards.filter(h => bits & h.bit).map(h => h.name).join(", ") || "none";
const isUnknown = h => h.name === UNSEEN.name || h.name === UNMAPPED.name;
const excludes = h => isUnknown(h) || (data.excluding & h.bit);
// State of a grid point in assessment k (-1: the last one), shown by the layer LANDING.
const ALLOWED = 0, EXCLUDED = 1, PARTLY = 2, UNOBSERVED = 3, UNESTIMATED = 4;
function stateAt(i, k) {
  if (k >= 0) return isUnobservedAt(i, k) ? UNOBSERVED : allowedAt(i, k) ? ALLOWED : EXCLUDED;
  const bits = grid.hazard[i];
  return bits & UNMAPPED.bit ? UNESTIMATED : bits & UNSEEN.bit ? UNOBSERVED :
    grid.safe[i] ? ALLOWED : bits & PARTLY_UNOBSERVED.bit ? PARTLY : EXCLUDED;
}

function makeLayers() {
  const onGrid = (name, title, unit, values, map, none, more = {}) =>
    (LAYERS[name] = { title, unit, of: "grid", values, limits: values.limits, map, none, ...more });
  const onLeaves = (name, title, unit, values, limits) => (LAYERS[name] =
    { title, unit, of: "fine", at: k => values[fine.leaf[k]], limits, map: "deviation",
      none: "no estimate" });
  const chance = { power: 10, percent: true, map: "score" };
  const how = grid.risk || grid.score;
  onGrid(LANDING, grid.risk ? "Where to land: predicted risk" :
    "Where to land: score, lower is better", "", how, "score", UNSEEN.name,
    { ofTime: true, states: true, ...(grid.risk && { ...chance, mark: Math.log10(data.limit.risk),
      markName: "limit (lss.max_risk)",
      note: "Risk of a touchdown exactly here. The success of a site includes touchdowns off the aim (lss.dispersion)." }) });
  for (const layer of data.layers) {
    LAYERS[layer.name] = { ...layer, of: "grid", limits: layer.values.limits, map: layer.kind,
                           none: "not known" };
  }
  if (grid.aim) {
    onGrid("aim", "Risk if aimed here", "", grid.aim, "score", UNSEEN.name,
      { ...chance, mark: Math.log10(data.limit.good), markName: "good",
        note: "Includes the touchdown dispersion. Sites are ranked by this." });
  }
  LAYERS.elevation = { title: "Elevation of the map's planes", unit: "m", of: "fine",
    at: k => fine.z[k], limits: limitsOf(fine.z), map: "elevation", none: UNSEEN.name };
  const filled = data.hazards.filter(excludes), lines = data.hazards.filter(h => !excludes(h));
  LAYERS.hazards = {
    title: "Why landing is excluded", of: "grid", outlines: lines,
    classes: [{ name: "none", colour: data.colours.clear }, ...filled],
    value: i => filled.findIndex(h => grid.hazard[i] & h.bit) + 1,
    note: "For the centre of the vehicle. " +
      (lines.length ? "Outlines do not exclude landing. " : ""),
  };
  onGrid("slope", "Slope at the scale of the lander", "°", grid.slope, "slope", UNSEEN.name,
         { mark: grid.slope.mark, markName: "limit" });
  if (grid.risk) onGrid("score", "Score, lower is better", "", grid.score, "score", "excluded");
  const sizes = [leaves.max_level, leaves.min_level].map(l => Math.log2(leafSize(l)));
  if (leaves.deviation) {
    onLeaves("deviation", "Standard deviation of the height", "m", leaves.deviation,
             leaves.deviation.limits);
    onLeaves("relative", "… without the common pose error", "m", leaves.relative,
             leaves.relative.limits);
    onLeaves("roughness", "Roughness (distance from the plane)", "m", leaves.roughness,
             leaves.roughness.limits);
  }
  onLeaves("cells", "Size of the cells", "m",
           Float64Array.from(leaves.level, l => Math.log2(leafSize(l))), sizes);
  LAYERS.cells.power = 2;
}
function limitsOf(values) { // 1st and 99th percentiles
  const known = Float64Array.from(values).filter(v => !Number.isNaN(v)).sort();
  if (!known.length) return [0, 1];
  const at = share => known[Math.round(share * (known.length - 1))];
  return [at(0.01), Math.max(at(0.99), at(0.01) + 1e-6)];
}
function colour(layer, value) {
  if (Number.isNaN(value) || value === undefined) return UNKNOWN;
  const [low, high] = layer.limits, table = data.maps[layer.map];
  // The layer LANDING is grey beyond the limit.
  const share = clamp((value - low) / (high - low || 1), 0, 1);
  const limit = layer.states && layer.mark !== undefined ? (layer.mark - low) / (high - low) : 1;
  if (share > limit + 1e-9) return greyAt(share, limit);
  const k = 3 * Math.round(255 * clamp(share / limit, 0, 1));
  return [table[k], table[k + 1], table[k + 2]];
}
const greyAt = (share, limit) => new Array(3).fill(
  Math.round(170 - 90 * clamp((share - limit) / (1 - limit || 1), 0, 1)));
function stateColour(layer, i, k) {
  const state = stateAt(i, k), value = k < 0 ? layer.values[i] : riskAt(i, k);
  if (state === UNOBSERVED) return rgb(UNSEEN.colour);
  if (state === UNESTIMATED) return rgb(UNMAPPED.colour);
  if (state === PARTLY) return rgb(PARTLY_UNOBSERVED.colour);
  const [low, high] = layer.limits, limit = layer.mark === undefined ? high : layer.mark;
  if (Number.isNaN(value)) return state === ALLOWED ? colour(layer, low) : greyAt(1, 0);
  if (state === ALLOWED) return colour(layer, Math.min(value, limit));
  return greyAt(clamp((value - low) / (high - low || 1), 0, 1), (limit - low) / (high - low || 1));
}
const painted = {};
function canvasOf(nx, ny, colourOf) { // a pixel per value, the row of the smallest y at the bottom
  const canvas = document.createElement("canvas");
  canvas.width = nx; canvas.height = ny;
  const context = canvas.getContext("2d"), image = context.createImageData(nx, ny);
  for (let j = 0; j < ny; j++) for (let i = 0; i < nx; i++) {
    const to = 4 * ((ny - 1 - j) * nx + i), [r, g, b, a = 255] = colourOf(j * nx + i);
    image.data[to] = r; image.data[to + 1] = g; image.data[to + 2] = b; image.data[to + 3] = a;
  }
  context.putImageData(image, 0, 0);
  return canvas;
}
const gridBox = () => [grid.xmin - grid.spacing / 2, grid.ymin - grid.spacing / 2,
                       grid.nx * grid.spacing, grid.ny * grid.spacing];
function cached(key, make) { // images of earlier assessments are dropped
  if (!painted[key]) {
    for (const old of Object.keys(painted)) if (!old.endsWith(" -1")) delete painted[old];
    painted[key] = make();
  }
  return painted[key];
}
function picture(name, k = -1) { // canvas of a layer at assessment k (-1: the last one)
  return cached(`${name} ${k}`, () => {
    const layer = LAYERS[name], ofFine = layer.of === "fine";
    const colours = layer.classes && layer.classes.map(c => rgb(c.colour));
    const isHidden = k < 0 ? () => false : ofFine ? i => isUnobservedAt(gridUnder(i), k) : i => isUnobservedAt(i, k);
    const colourOf = layer.states ? i => stateColour(layer, i, k) : i => (isHidden(i) ? UNKNOWN :
      colours ? colours[layer.value ? layer.value(i) : layer.values[i]] :
      colour(layer, ofFine ? layer.at(i) : layer.values[i]));
    return ofFine ? { canvas: canvasOf(fine.n, fine.n, colourOf),
                      box: [leaves.xmin, leaves.ymin, leaves.size, leaves.size] } :
      { canvas: canvasOf(grid.nx, grid.ny, colourOf), box: gridBox() };
  });
}
function excludedMask(k = view.answer) { // opaque where observed ground is excluded
  return cached(`excluded ${k}`, () => ({ box: gridBox(), canvas: canvasOf(grid.nx, grid.ny, i => {
    const state = stateAt(i, k);
    return [0, 0, 0, state === EXCLUDED || state === PARTLY ? 255 : 0];
  }) }));
}
function gridUnder(k) {
  return gridPointAt(leaves.xmin + (k % fine.n + 0.5) * fine.size,
                     leaves.ymin + (Math.floor(k / fine.n) + 0.5) * fine.size);
}
let relief = null;
function reliefPicture(k = -1) { // relief of the ground observed by assessment k (-1: the last one)
  if (relief && relief.k === k) return relief;
  const canvas = canvasOf(fine.n, fine.n, i =>
    new Array(3).fill(k >= 0 && isUnobservedAt(gridUnder(i), k) ? 128 : fine.shade[i]));
  return (relief = { k, canvas, box: [leaves.xmin, leaves.ymin, leaves.size, leaves.size] });
}

// ---- legend ------------------------------------------------------------------------------------
const swatch = (style, name, value = "") =>
  `<span class="key"><i style="${style}"></i>${name}<b>${value}</b></span>`;
const FLIGHT_MARKS = "Blue: path. ×: planned point. Orange: decisions. Red: faults.";
const HATCHED = "background:repeating-linear-gradient(135deg,#333 0 1px,#aaa 1px 4px)";
function areas(count, classOf) { // of each class, m²; grid points at the edge count half
  const found = new Array(count).fill(0), { nx, ny } = grid;
  for (let j = 0; j < ny; j++) for (let i = 0; i < nx; i++) {
    const weight = (i % (nx - 1) ? 1 : 0.5) * (j % (ny - 1) ? 1 : 0.5);
    found[classOf(j * nx + i)] += weight * grid.spacing ** 2;
  }
  return found;
}
function stateLegend() { // of the layer LANDING, with areas
  const found = areas(5, i => stateAt(i, view.answer)), style = {
    [ALLOWED]: "background:linear-gradient(90deg," + [0, 0.5, 1].map(s => { const l = LAYERS[LANDING];
      const top = l.mark === undefined ? l.limits[1] : l.mark;
      return `rgb(${colour(l, l.limits[0] + s * (top - l.limits[0]))})`; }) + ")",
    [EXCLUDED]: HATCHED, [PARTLY]: `background:repeating-linear-gradient(135deg,#333 0 1px,${PARTLY_UNOBSERVED.colour} 1px 4px)`,
    [UNOBSERVED]: `background:${UNSEEN.colour}`, [UNESTIMATED]: `background:${UNMAPPED.colour}` };
  const names = ["allowed", "excluded", "excluded: " + PARTLY_UNOBSERVED.name, UNSEEN.name, UNMAPPED.name];
  return found.map((area, k) => (area ? swatch(style[k], names[k], `${grid.stride > 1 ? "≈ " : ""}${few(area)} m²`) : "")).join("");
}
function legend() {
  const layer = LAYERS[view.layer], box = byId("legend");
  const note = (layer.note || "") + (view.answer < 0 || layer.ofTime ? "" :
    " Ground observed by the shown time, with its values at the end.");
  const hatch = view.excluded ? swatch(HATCHED, "hatched: landing excluded") : "";
  box.innerHTML = layer.classes ? "" : "<canvas></canvas>";
  if (layer.classes) {
    const found = areas(layer.classes.length, layer.value || (k => layer.values[k]));
    box.innerHTML = layer.classes.map((k, i) =>
      (found[i] ? swatch(`background:${k.colour}`, k.name, `${few(found[i])} m²`) : "")).join("") +
      (layer.outlines || []).map(k =>
        swatch(`border:2px solid ${k.colour}`, k.name, "outline")).join("") + hatch;
  } else box.innerHTML += layer.states ? stateLegend() :
    swatch(`background:rgb(${UNKNOWN})`, layer.none) + hatch;
  box.innerHTML += note && `<p class="note">${note}</p>`;
  if (data.flight) box.innerHTML += `<p class="note">${FLIGHT_MARKS}</p>`;
  if (!layer.classes) scale(box.firstChild, layer);
}
function scale(canvas, layer) { // colour bar with ticks and the mark of a limit
  const c = fitCanvas(canvas), w = canvas.clientWidth - 24, [low, high] = layer.limits;
  const at = v => 12 + w * (v - low) / (high - low || 1);
  for (let p = 0; p < w; p++) {
    c.fillStyle = `rgb(${colour(layer, low + (high - low) * p / (w - 1))})`;
    c.fillRect(12 + p, 0, 1.5, 14);
  }
  c.fillStyle = ink("--ink"); c.font = "11px system-ui, sans-serif"; c.textBaseline = "top";
  const drawText = (v, text, y) => {
    const half = c.measureText(text).width / 2;
    c.textAlign = "center"; c.fillText(text, clamp(at(v), half, w + 24 - half), y);
  };
  const marks = ticks(layer);
  marks.forEach((v, i) => {
    c.fillRect(at(v) - 0.5, 14, 1, 4);
    drawText(v, inUnit(layer, v) + (i === marks.length - 1 && layer.unit ? " " + layer.unit : ""), 20);
  });
  if (layer.mark === undefined || layer.mark > high) return;
  c.fillRect(at(layer.mark) - 1, 0, 2, 36);
  drawText(layer.mark, `${layer.markName} ${inUnit(layer, layer.mark)}${layer.unit}`, 36);
}
function inUnit(layer, v) { // per cent, or the value itself
  const value = layer.power ? layer.power ** v : v;
  return layer.percent ? `${short(100 * value)} %` : short(value);
}
function ticks(layer) { // round numbers, or powers on logarithmic scales
  const [low, high] = layer.limits;
  const step = layer.power ? Math.ceil((high - low) / 6) || 1 : nice((high - low) / 4);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) {
    found.push(k * step);
  }
  return found.length > 1 ? found : [low, high];
}
