// SPDX-License-Identifier: Apache-2.0
// The embedded data: element "data" is JSON (page_data.py), element "columns" has the arrays it
// refers to (pages.py). All scripts share one scope; start.js unpacks the arrays and runs last.
"use strict";
const root = document.documentElement;
window.addEventListener("error", e => { root.dataset.error = e.message; });
window.addEventListener("unhandledrejection", e => { root.dataset.error = String(e.reason); });
const byId = id => document.getElementById(id);
const data = JSON.parse(byId("data").textContent);
const { grid, leaves, sites } = data;

async function inflate(text) {
  const raw = Uint8Array.from(atob(text), c => c.charCodeAt(0));
  const stream = new Blob([raw]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Response(stream).arrayBuffer();
}

const KINDS = { u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, f4: Float32Array };
function unpack(buffer, header) {
  const raw = new KINDS[header.kind](buffer, header.at, header.length);
  if (header.step === undefined) return raw;
  const nanCode = header.kind === "u1" ? 0xff : 0xffff;
  return Float64Array.from(raw, v => (v === nanCode ? NaN : header.low + header.step * v));
}
function unpackAll(buffer, where) { // replace each reference by its array
  for (const [name, value] of Object.entries(where)) {
    if (!value || typeof value !== "object") continue;
    if (Array.isArray(value) && typeof value[0] !== "object") continue;
    if (value.kind in KINDS && value.at !== undefined) {
      const column = unpack(buffer, value);
      where[name] = Object.assign(column, { limits: value.limits, mark: value.mark });
    } else unpackAll(buffer, value);
  }
}

async function loadLibrary(id) { // on first use
  const script = document.createElement("script");
  script.textContent = new TextDecoder().decode(await inflate(byId(id).textContent));
  document.body.append(script);
}

// ---- utilities ---------------------------------------------------------------------------------
const coloursKnown = {};
const rgb = hex => (coloursKnown[hex] = coloursKnown[hex] || [1, 3, 5].map(k => parseInt(hex.slice(k, k + 2), 16)));
const clamp = (v, low, high) => Math.min(Math.max(v, low), high);
function nice(about) { // 1, 2 or 5 times a power of ten
  const power = 10 ** Math.floor(Math.log10(about)), m = about / power;
  return (m < 1.5 ? 1 : m < 3.5 ? 2 : m < 7.5 ? 5 : 10) * power;
}
const plain = (v, step) => v.toFixed(Math.max(0, Math.ceil(-Math.log10(step) - 1e-9)));
const short = v => (v === null || Number.isNaN(v) ? "–" : Math.abs(v) >= 100 ? v.toFixed(0) :
  String(parseFloat(v.toPrecision(3))));
const few = v => (v >= 9.95 || !v ? Math.round(v).toLocaleString("en") : String(parseFloat(v.toPrecision(2))));
const shareText = v => (Number.isNaN(v) ? "–" : // per cent, never rounded up to 100
  v >= 99.85 ? Math.min(v, 99.99).toFixed(2) : v.toFixed(1));
const withUnit = (v, digits, unit) => (Number.isNaN(v) ? "–" : v.toFixed(digits) + " " + unit);
const probe = document.body.appendChild(document.createElement("i"));
function ink(name) { // a colour of page.css in the current theme
  probe.style.color = `var(${name})`;
  return getComputedStyle(probe).color;
}
