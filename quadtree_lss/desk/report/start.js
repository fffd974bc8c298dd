// SPDX-License-Identifier: Apache-2.0
// Unpack the embedded data and show it.
"use strict";
function refresh() { // after a change of size or medium
  legend(); resized(); resizePlots();
  if (space) space.resize();
}
async function start() {
  unpackAll(await inflate(byId("columns").textContent), data);
  rasteriseLeaves();
  const likely = data.history && data.history.risk, all = grid.nx * grid.ny;
  if (likely) for (let i = all; i < likely.length; i++) likely[i] += likely[i - all]; // stored as differences
  const seen = data.history && data.history.seen, row = Math.ceil(all / 8);
  if (seen) for (let i = row; i < seen.length; i++) seen[i] ^= seen[i - row];
  extent = seenBox();
  makeLayers();
  view.layer = data.layers.length && !data.flight ? data.layers[0].name : LANDING;
  panel();
  addPointerHandlers(map); addPointerHandlers(second);
  byId("layer").value = view.layer;
  fitSites(); legend();
  timeline(); startFlight(); timing();
  const atTarget = sites.findIndex(s => data.target &&
    Math.hypot(s.x - data.target[0], s.y - data.target[1]) < data.lander.radius);
  choose(sites.length ? Math.max(atTarget, 0) : -1, false);
  restoreView();
  new ResizeObserver(refresh).observe(byId("frame"));
  // A print has its own width and the light theme, so canvases are drawn again.
  window.addEventListener("beforeprint", () => {
    view.printing = true; root.classList.add("printing");
    for (const d of document.querySelectorAll("details.warning")) d.open = true;
    legend(); resized(); drawNow(); resizePlots();
  });
  window.addEventListener("afterprint", () => {
    view.printing = false; root.classList.remove("printing");
    refresh();
  });
  drawNow();
  root.dataset.ready = "yes";
}
start();
