// SPDX-License-Identifier: Apache-2.0
// The panel beside the map: layers, table of sites, modes; the view in the address.
"use strict";
function options(select, none) {
  select.innerHTML = (none ? `<option value="">${none}</option>` : "") +
    Object.entries(LAYERS).map(([name, layer]) =>
      `<option value="${name}">${layer.title}</option>`).join("");
}
function setLayer(name) {
  view.layer = byId("layer").value = name;
  legend();
  if (space) space.update();
  draw();
}
function nextLayer() {
  const names = Object.keys(LAYERS);
  setLayer(names[(names.indexOf(view.layer) + 1) % names.length]);
}
function setBeside(name) {
  view.beside = byId("layer-2").value = name;
  second.hidden = !name;
  resized();
}
function setMode(mode) {
  view.mode = mode;
  for (const name of ["map", "scene", "section"]) {
    byId(`mode-${name}`).setAttribute("aria-pressed", String(name === mode));
  }
  const inSpace = mode === "scene";
  map.hidden = inSpace; second.hidden = inSpace || !view.beside;
  byId("scene").hidden = byId("scene-tools").hidden = !inSpace;
  hideTooltip();
  showSection(mode === "section");
  if (inSpace) showScene();
  else resized();
  saveView();
}
function showSiteReason(k) { // highlight its row, show its reason
  for (const row of document.querySelectorAll("tr[data-site]")) {
    const chosen = Number(row.dataset.site) === k;
    row.classList.toggle("chosen", chosen);
    row.setAttribute("aria-selected", String(chosen));
  }
  const site = sites[k];
  byId("why").innerHTML = "";
  if (site) {
    byId("why").innerHTML = `<b>Site ${site.rank}</b>: `;
    byId("why").append(site.reason + (site.against ? `. Against it: ${site.against}` : ""));
  }
}
function choose(k, going = true) { // select site k and move the view to it
  view.site = k;
  if (view.answer < 0) showSiteReason(k);
  const site = sites[k];
  if (site && going) goTo(site);
  if (space) space.update(going);
  if (view.mode === "section") { view.line = defaultLine(); drawSection(); }
  draw();
}
function connectRows() {
  const found = [...document.querySelectorAll("tr[data-site]")];
  found.forEach((row, k) => {
    row.onclick = () => choose(k);
    row.onmouseenter = () => { view.cursor = sites[k]; draw(); };
    row.onmouseleave = hideTooltip;
    row.onkeydown = e => {
      const to = { ArrowDown: k + 1, ArrowUp: k - 1, Home: 0, End: found.length - 1 }[e.key];
      if (e.key === "Enter" || e.key === " ") choose(k);
      else if (to === undefined) return;
      else if (found[to]) found[to].focus();
      e.preventDefault(); e.stopPropagation();
    };
  });
}

// ---- the address -------------------------------------------------------------------------------
const SHOWN = ["sites", "relief", "excluded", "leaves", "track"];
let saveTimer = 0;
function address() {
  const words = { layer: view.layer, x: view.x.toFixed(2), y: view.y.toFixed(2),
                  scale: isWhole() ? "" : view.scale.toFixed(2), beside: view.beside,
                  mode: view.mode === "map" ? "" : view.mode,
                  site: view.site >= 0 ? sites[view.site].rank : "",
                  answer: view.answer >= 0 ? view.answer : "",
                  line: view.line ? view.line.flatMap(p => [p.x.toFixed(2), p.y.toFixed(2)]).join() : "",
                  camera: view.mode === "scene" && space ? space.camera() : "",
                  show: SHOWN.filter(name => view[name]).join() };
  return Object.entries(words).filter(([, v]) => v !== "").map(([k, v]) => `${k}=${v}`).join("&");
}
function saveView() {
  clearTimeout(saveTimer);
  saveTimer = setTimeout(() => {
    try { history.replaceState(null, "", "#" + address()); }
    catch (refused) { /* some browsers forbid this for files; the link button still works */ }
  }, 300);
}
function restoreView() { // restore the view from the address
  const words = new URLSearchParams(location.hash.slice(1)), number = name => Number(words.get(name));
  if (words.has("show")) {
    for (const name of SHOWN) byId(`show-${name}`).checked = view[name] =
      words.get("show").split(",").includes(name);
  }
  if (LAYERS[words.get("layer")]) setLayer(words.get("layer"));
  if (LAYERS[words.get("beside")]) setBeside(words.get("beside"));
  if (data.history && words.has("answer")) setInstant(number("answer"));
  if (sites[number("site") - 1]) choose(number("site") - 1, !words.has("scale"));
  if (words.has("scale")) {
    Object.assign(view, { x: number("x"), y: number("y"), scale: number("scale") });
  }
  const line = (words.get("line") || "").split(",").map(Number);
  if (line.length === 4) view.line = [{ x: line[0], y: line[1] }, { x: line[2], y: line[3] }];
  view.camera = words.get("camera");
  if (["scene", "section"].includes(words.get("mode"))) setMode(words.get("mode"));
}
function setTheme(theme) {
  root.dataset.theme = theme;
  legend(); draw(); resizePlots();
  if (space) space.update();
}
const isDark = () => (root.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ?
  "dark" : "light")) === "dark";

function panel() {
  options(byId("layer")); options(byId("layer-2"), "nothing");
  byId("layer").onchange = e => setLayer(e.target.value);
  byId("layer-2").onchange = e => setBeside(e.target.value);
  byId("zoom-in").onclick = () => (view.mode === "scene" ? space.zoom(0.8) : zoom(1.5));
  byId("zoom-out").onclick = () => (view.mode === "scene" ? space.zoom(1.25) : zoom(1 / 1.5));
  byId("zoom-fit").onclick = () => (view.mode === "scene" ? space.fit() : fit());
  for (const mode of ["map", "scene", "section"]) byId(`mode-${mode}`).onclick = () => setMode(mode);
  byId("section-close").onclick = () => setMode("map");
  for (const name of SHOWN) {
    byId(`show-${name}`).onchange = e => {
      view[name] = e.target.checked;
      if (space) space.update();
      legend(); draw();
    };
  }
  byId("opacity").oninput = e => { view.opacity = Number(e.target.value); draw(); };
  byId("theme").onclick = () => setTheme(isDark() ? "light" : "dark");
  byId("link").onclick = async () => {
    const link = location.href.split("#")[0] + "#" + address();
    try { await navigator.clipboard.writeText(link); byId("link").textContent = "copied"; }
    catch (refused) { prompt("Link to this view", link); }
    setTimeout(() => { byId("link").textContent = "link"; }, 1500);
  };
  const filter = byId("filter");
  filter.oninput = () => {
    byId("configuration").closest("details").open = true;
    for (const row of document.querySelectorAll("#configuration tbody tr")) {
      row.hidden = !row.textContent.toLowerCase().includes(filter.value.toLowerCase());
    }
  };
  connectRows();
  document.addEventListener("keydown", keys);
  window.addEventListener("hashchange", () => { // a link within the page
    restoreView(); draw();
    byId("frame").scrollIntoView({ block: "nearest" });
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    legend(); draw(); resizePlots();
  });
}
