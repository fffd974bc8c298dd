# SPDX-License-Identifier: Apache-2.0
"""Pages as tests look at them: their markup, their columns, and a browser that shows them."""

import base64
import html
import json
import re
import shutil
import subprocess
import zlib
from html.parser import HTMLParser
from importlib.resources import files

import numpy as np
import pytest

from quadtree_lss.desk.exchange.saved import Grid, Results

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
in_a_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium on this computer")
FLAGS = (
    "--headless --no-sandbox --disable-quic --no-first-run --disable-background-networking"
    " --disable-component-update --disable-sync --use-gl=angle --use-angle=swiftshader"
    " --enable-unsafe-swiftshader --virtual-time-budget=10000"
).split()

HELPERS = """
const answers = {};
const tellTest = (name, value) => { answers[name] = value; };
const at = (type, x, y, more = {}) => map.dispatchEvent(new PointerEvent(type, {
  clientX: map.getBoundingClientRect().left + x, clientY: map.getBoundingClientRect().top + y,
  pointerId: 1, bubbles: true, ...more }));
const press = (key, on = document.body) =>
  on.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true }));
const shown = () => Object.fromEntries([...document.querySelectorAll("#tooltip tr")].map(
  r => [r.children[0].textContent, r.children[1].textContent]));
const move = (id, value) => { byId(id).value = value;
  for (const type of ["input", "change"]) byId(id).dispatchEvent(new Event(type)); };
const colourAt = (x, y) => { drawNow(); const r = window.devicePixelRatio || 1;
  return [...map.getContext("2d").getImageData(x * r, y * r, 1, 1).data].slice(0, 3).join(); };
// Timers let virtual time run out, which waits for no thread that unpacks; messages do not.
const turn = () => new Promise(r => {
  const channel = new MessageChannel();
  channel.port1.onmessage = r; channel.port2.postMessage(0);
});
const until = async done => {
  for (let k = 1; !done(); k++) await (k % 500 ? turn() : new Promise(r => setTimeout(r, 20)));
};
"""


def changed(results, **parts):
    """Results of which some files hold something else."""
    found = Results(results.folder)
    vars(found).update({**vars(results), **parts, "grid": Grid(parts.get("grid", results.grid))})
    return found


class Page(HTMLParser):
    """Elements, attributes and the content of scripts."""

    VOID = {"meta", "input", "br", "img", "link"}

    def __init__(self, text):
        super().__init__()
        self.found, self.open, self.scripts = [], [], {}
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attributes):
        self.found.append((tag, dict(attributes)))
        if tag not in self.VOID:
            self.open.append((tag, dict(attributes)))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag

    def handle_data(self, text):
        if self.open and self.open[-1][0] == "script":
            name = self.open[-1][1].get("id", "program")
            self.scripts[name] = self.scripts.get(name, "") + text

    @property
    def data(self):
        return json.loads(self.scripts["data"])

    def column(self, about):
        """An array of the page, in its own unit."""
        content = zlib.decompress(base64.b64decode(self.scripts["columns"]))
        return column(content, about)


def column(content, about):
    raw = np.frombuffer(content, f"<{about['kind']}", about["length"], about["at"])
    if "step" not in about:
        return raw
    none = np.iinfo(raw.dtype).max
    return np.where(raw == none, np.nan, about["low"] + about["step"] * raw)


PHONE = """<!DOCTYPE html><html><body style="margin:0">
<iframe style="border:0;width:%dpx;height:%dpx"></iframe><script>
const frame = document.querySelector("iframe"), own = document.documentElement.dataset;
frame.src = "page.html";
window.addEventListener("message", e => { Object.assign(own, e.data); });
</script></body></html>"""


def in_browser(text, folder, steps="", size=(1400, 900), address="", flags=()):
    """What ``steps`` told by `tellTest` after acting on the page as a person would.

    Narrower than 500 px the page is in a frame: no window of a Chromium without a screen is.
    """
    program = f"""{HELPERS}
    (async () => {{
      await until(() => root.dataset.ready || root.dataset.error);
      {steps}
      root.dataset.told = JSON.stringify(answers);
      if (parent !== window) parent.postMessage({{ ...root.dataset }}, "*");
    }})();"""
    path = folder / "page.html"
    path.write_text(text.replace("</body>", f"<script>{program}</script></body>"))
    if size[0] < 500:
        path = folder / "phone.html"
        path.write_text(PHONE % size)
    size_flag = f"--window-size={size[0]},{size[1]}"
    dom = run_browser(folder, *flags, size_flag, "--dump-dom", path.as_uri() + address)
    (tag,) = re.findall(r"<html[^>]*>", dom)
    assert "data-error" not in tag, tag
    found = re.search(r'data-told="([^"]*)"', tag)
    assert found, f"the page did not get ready: {tag}"
    return json.loads(html.unescape(found[1]))


AXE = """
const script = document.createElement("script");
script.textContent = new TextDecoder().decode(Uint8Array.from(atob("%s"), c => c.charCodeAt(0)));
document.body.append(script); script.remove();
for (const d of document.querySelectorAll("details")) d.open = true;
for (const theme of ["light", "dark"]) {
  root.dataset.theme = theme;
  const { passes, violations } = await axe.run(document);
  tellTest(theme, [passes.length, violations.filter(v => /serious|critical/.test(v.impact))
    .map(v => `${v.help}: ${v.nodes.slice(0, 3).map(n => n.target + " " + n.failureSummary)}`)]);
}
"""


def accessible(text, folder):
    """Whether axe-core finds no serious and no critical fault of a page, light and dark."""
    pytest.importorskip("axe_core_python")
    program = files("axe_core_python").joinpath("axe.min.js").read_bytes()
    told = in_browser(text, folder, AXE % base64.b64encode(program).decode())
    for passed, faults in told.values():
        assert passed > 15 and not faults, "\n".join(faults)
    return len(told) == 2


def sheets(text, folder):
    """How many sheets of paper a page prints on."""
    page, paper = folder / "page.html", folder / "page.pdf"
    page.write_text(text)
    run_browser(folder, f"--print-to-pdf={paper}", page.as_uri())
    return len(re.findall(rb"/Type\s*/Page\b", paper.read_bytes()))


def run_browser(folder, *arguments):
    """What it prints."""
    command = [BROWSER, *FLAGS, f"--user-data-dir={folder / 'profile'}", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stderr
    return done.stdout
