// SPDX-License-Identifier: Apache-2.0
// The planes of the map: leaf, height and shading of each place.
"use strict";
const leafSize = level => leaves.size / 2 ** level;
const fine = { n: 0, size: 0, leaf: null, z: null, shade: null };

function rasteriseLeaves() { // rasterise the leaves to at most 1024 cells a side
  const level = Math.min(leaves.max_level, 10);
  const n = fine.n = 2 ** level;
  fine.size = leaves.size / n;
  fine.leaf = new Int32Array(n * n).fill(-1);
  for (let r = 0; r < leaves.number; r++) {
    const up = level - leaves.level[r], side = up > 0 ? 2 ** up : 1, scale = 2 ** up;
    const i0 = Math.floor(leaves.ix[r] * scale), j0 = Math.floor(leaves.iy[r] * scale);
    for (let j = j0; j < j0 + side; j++) fine.leaf.fill(r, j * n + i0, j * n + i0 + side);
  }
  fine.z = new Float32Array(n * n);
  for (let j = 0; j < n; j++) for (let i = 0; i < n; i++) {
    const x = leaves.xmin + (i + 0.5) * fine.size, y = leaves.ymin + (j + 0.5) * fine.size;
    fine.z[j * n + i] = seenAt(x, y) ? heightAt(x, y) : NaN;
  }
  computeShading();
}
function leafAt(x, y) {
  const n = fine.n;
  const i = Math.floor((x - leaves.xmin) / fine.size), j = Math.floor((y - leaves.ymin) / fine.size);
  return i >= 0 && j >= 0 && i < n && j < n ? fine.leaf[j * n + i] : -1;
}
function gridPointAt(x, y) {
  const i = Math.round((x - grid.xmin) / grid.spacing);
  const j = Math.round((y - grid.ymin) / grid.spacing);
  return i >= 0 && j >= 0 && i < grid.nx && j < grid.ny ? j * grid.nx + i : -1;
}
const UNSEEN = data.hazards.find(h => h.bit === 128);
const UNMAPPED = data.hazards.find(h => h.bit === 64); // observed but not estimated ground has both bits
const PARTLY_UNOBSERVED = data.hazards.find(h => h.bit === 32);
function seenAt(x, y) {
  const i = gridPointAt(x, y);
  return i >= 0 && !(grid.hazard[i] & UNSEEN.bit);
}
function planeAt(r, x, y) {
  const size = leafSize(leaves.level[r]);
  const cx = leaves.xmin + (leaves.ix[r] + 0.5) * size, cy = leaves.ymin + (leaves.iy[r] + 0.5) * size;
  return leaves.z[r] + leaves.slope_x[r] * (x - cx) + leaves.slope_y[r] * (y - cy);
}
// Clamp a height to the measured range; a bound that is NaN has no effect.
const within = (z, low, high) => (z < low ? low : z > high ? high : z);
function heightAt(x, y) { // by the plane of an estimated leaf, otherwise by the landing grid
  const r = leafAt(x, y);
  if (r >= 0 && leaves.z && leaves.measured[r]) {
    const z = planeAt(r, x, y);
    return within(z, leaves.low ? leaves.low[r] : NaN, leaves.high ? leaves.high[r] : NaN);
  }
  const i = gridPointAt(x, y);
  return i < 0 ? NaN : grid.elevation[i];
}
function computeShading() { // of each cell, lit from the north-west; 128 is level ground
  const { n, z } = fine, shade = fine.shade = new Uint8Array(n * n);
  const gx = new Float32Array(n * n), gy = new Float32Array(n * n), steep = [];
  const middle = k => [leaves.xmin + (k % n + 0.5) * fine.size,
                       leaves.ymin + (Math.floor(k / n) + 0.5) * fine.size];
  const large = Math.log2(leaves.size / fine.size) - 2; // level of leaves four cells wide
  const beside = (k, v) => { // ignore steps between large planes below the noise
    const r = fine.leaf[k];
    if (r === fine.leaf[v] || r < 0 || !leaves.z || !leaves.measured[r] ||
        leaves.level[r] > large) return z[v];
    const goes = planeAt(r, ...middle(v));
    return Math.abs(z[v] - goes) < data.noise ? goes : z[v];
  };
  const rise = (k, a, b) => { // slope between the neighbours, or the cell and its only neighbour
    const high = Number.isNaN(z[b]) ? z[k] : beside(k, b);
    const low = Number.isNaN(z[a]) ? z[k] : beside(k, a);
    const steps = (b !== k && !Number.isNaN(z[b])) + (a !== k && !Number.isNaN(z[a]));
    return steps ? (high - low) / (steps * fine.size) : 0;
  };
  for (let j = 0; j < n; j++) for (let i = 0; i < n; i++) {
    const k = j * n + i;
    if (Number.isNaN(z[k])) continue;
    gx[k] = rise(k, i > 0 ? k - 1 : k, i < n - 1 ? k + 1 : k);
    gy[k] = rise(k, j > 0 ? k - n : k, j < n - 1 ? k + n : k);
    if (k % 7 === 0) steep.push(Math.hypot(gx[k], gy[k]));
  }
  // Exaggerate slopes so that the steepest tenth is clearly shaded.
  steep.sort((a, b) => a - b);
  const factor = clamp(0.6 / (steep[Math.floor(0.9 * steep.length)] || 1), 0.5, 6);
  for (let k = 0; k < n * n; k++) {
    const a = factor * gx[k], b = factor * gy[k];
    const lit = (0.70711 + 0.5 * (a - b)) / Math.hypot(a, b, 1) / 0.70711;
    shade[k] = Number.isNaN(z[k]) ? 128 : clamp(lit < 1 ? 128 * Math.max(lit, 0) + 6 :
      128 + 100 * (lit - 1) / 0.41421, 12, 236);
  }
}
function seenBox() { // box of the estimated ground without the outermost thousandth
  const xs = new Uint32Array(grid.nx), ys = new Uint32Array(grid.ny);
  let total = 0;
  for (let j = 0; j < grid.ny; j++) for (let i = 0; i < grid.nx; i++) {
    if (grid.hazard[j * grid.nx + i] & UNSEEN.bit) continue;
    xs[i]++; ys[j]++; total++;
  }
  if (!total) {
    return { x0: leaves.xmin, y0: leaves.ymin, x1: leaves.xmin + leaves.size,
             y1: leaves.ymin + leaves.size };
  }
  const ends = counts => {
    let sum = 0, low = -1, high = 0;
    counts.forEach((c, k) => {
      sum += c;
      if (low < 0 && sum > 0.0005 * total) low = k;
      if (sum <= 0.9995 * total) high = k + 1;
    });
    return [low, Math.min(high, counts.length - 1)];
  };
  const [i0, i1] = ends(xs), [j0, j1] = ends(ys), s = grid.spacing;
  return { x0: grid.xmin + (i0 - 1) * s, x1: grid.xmin + (i1 + 1) * s,
           y0: grid.ymin + (j0 - 1) * s, y1: grid.ymin + (j1 + 1) * s };
}
