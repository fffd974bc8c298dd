// SPDX-License-Identifier: Apache-2.0
// Charts of curves, drawn with uPlot.
"use strict";
const CURVES = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7a6a00", "#777777"];
const plots = [];
function plot(parent, high, options, columns) {
  const room = document.createElement("div");
  parent.append(room);
  const axis = { stroke: () => ink("--soft-ink"), font: "11px system-ui, sans-serif",
                 labelFont: "11px system-ui, sans-serif", labelSize: 16, size: 44,
                 grid: { stroke: () => ink("--line"), width: 1 }, ticks: { show: false } };
  const axes = options.axes.map((a, k) => ({ ...axis, ...(k ? { space: 24 } : { size: 26 }), ...a }));
  const size = () => ({ width: Math.max(room.clientWidth, 120), height: high });
  const chart = new uPlot({ ...options, axes, ...size() }, columns, room);
  plots.push({ chart, size, room });
  return chart;
}
function resizePlots() {
  for (const { chart, size, room } of plots) if (room.clientWidth) chart.setSize(size());
}
const valueWithUnit = unit => (u, v) => (v === null || v === undefined ? "–" : short(v) + unit);
const second_s = (u, v) => (v === null ? "" : v.toFixed(2) + " s");
function curve(label, stroke, unit = "", more = {}) {
  return { label, stroke, width: 1.3, value: valueWithUnit(unit), points: { show: false }, ...more };
}
function timing() {
  const parent = byId("timing"), { seconds, map_ms } = data.timing;
  if (!parent) return;
  plot(parent, 210, {
    scales: { x: { time: false }, y: { range: (u, low, high) => [0, high * 1.05 || 1] } },
    axes: [{ label: "time since the first scan, s" }, { label: "map update, ms" }],
    series: [{ label: "time", value: second_s }, curve("map update", CURVES[0], " ms")],
  }, [seconds, map_ms]);
}
