// SPDX-License-Identifier: Apache-2.0
// Unpacks what is embedded and shows it.
"use strict";
function again() { // after a change of size or of what it is shown on
  legend(); resized(); resizePlots();
  if (space) space.resize();
}
async function start() {
  unpackAll(await inflate(byId("columns").textContent), data);
  layOut();
  const likely = data.history && data.history.risk, all = grid.nx * grid.ny;
  if (likely) for (let i = all; i < likely.length; i++) likely[i] += likely[i - all]; // they are changes
  const seen = data.history && data.history.seen, row = Math.ceil(all / 8);
  if (seen) for (let i = row; i < seen.length; i++) seen[i] ^= seen[i - row];
  extent = seenBox();
  makeLayers();
  view.layer = data.layers.length && !data.flight ? data.layers[0].name : LANDING;
  panel();
  watch(map); watch(second);
  byId("layer").value = view.layer;
  fitSites(); legend();
  timeline(); startFlight(); timing();
  choose(sites.length ? 0 : -1, false);
  recall();
  new ResizeObserver(again).observe(byId("frame"));
  // Paper has a width of its own and no dark; a canvas must be drawn for it.
  window.addEventListener("beforeprint", () => {
    view.printing = true; root.classList.add("printing");
    for (const d of document.querySelectorAll("details.warning")) d.open = true;
    legend(); resized(); drawNow(); resizePlots();
  });
  window.addEventListener("afterprint", () => {
    view.printing = false; root.classList.remove("printing");
    again();
  });
  drawNow();
  root.dataset.ready = "yes";
}
start();
