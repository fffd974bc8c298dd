# SPDX-License-Identifier: Apache-2.0
"""Pages as tests look at them: their markup, their columns, and a browser that shows them."""

import base64
import itertools
import json
import os
import re
import shutil
import subprocess
import time
import zlib
from html.parser import HTMLParser
from importlib.resources import files
from select import select

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
    " --enable-unsafe-swiftshader"
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
const until = async done => { while (!done()) await new Promise(r => setTimeout(r, 5)); };
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


class Browser:
    """A Chromium that shows one page after the other, led by its DevTools protocol over pipes."""

    def __init__(self, folder):
        (theirs, self._out), (self._in, answers) = os.pipe(), os.pipe()

        def take():
            for given, number in ((theirs, 3), (answers, 4)):
                os.dup2(given, number)
                os.set_inheritable(number, True)

        flags = (*FLAGS, f"--user-data-dir={folder}", "--remote-debugging-pipe")
        options = {"close_fds": False, "preexec_fn": take, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen((BROWSER, *flags, "about:blank"), **options)
        os.close(theirs), os.close(answers)
        self._content, self._session, self._asked = b"", None, itertools.count(1)
        (target,) = [
            info["targetId"]
            for info in self.ask("Target.getTargets")["targetInfos"]
            if info["type"] == "page"
        ]
        told = self.ask("Target.attachToTarget", targetId=target, flatten=True)
        self._session = told["sessionId"]
        self.ask("Emulation.setFocusEmulationEnabled", enabled=True)

    def close(self):
        self.ask("Browser.close")
        self._process.wait()
        os.close(self._in), os.close(self._out)

    def ask(self, method, **params):
        """The answer to one command."""
        said = {"id": next(self._asked), "method": method, "params": params}
        said |= {"sessionId": self._session} if self._session else {}
        os.write(self._out, json.dumps(said).encode() + b"\0")
        while True:
            while b"\0" not in self._content:
                assert select([self._in], [], [], 180.0)[0], "the browser does not answer"
                assert (more := os.read(self._in, 1 << 16)), "the browser has ended"
                self._content += more
            told, _, self._content = self._content.partition(b"\0")
            if (told := json.loads(told)).get("id") == said["id"]:
                assert "error" not in told, told
                return told["result"]

    def show(self, address, size):
        """What the root element's data has once there is an answer or an error."""
        width, height = size
        how = {"deviceScaleFactor": 1, "mobile": False}
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height, **how)
        for url in ("about:blank", address):  # else another # is no new page
            self.ask("Page.navigate", url=url)
        look = {"expression": "({...document.documentElement.dataset})", "returnByValue": True}
        end = time.monotonic() + 180.0
        while time.monotonic() < end:
            told = self.ask("Runtime.evaluate", **look)["result"].get("value", {})
            if told.keys() & {"told", "error"}:
                return told
            time.sleep(0.02)
        raise TimeoutError(f"the page did not get ready: {told}")


def in_browser(browser, folder, text, steps="", size=(1400, 900), address=""):
    """What ``steps`` told by `tellTest` after acting on the page as a person would."""
    program = f"""{HELPERS}
    (async () => {{
      await until(() => root.dataset.ready || root.dataset.error);
      {steps}
      root.dataset.told = JSON.stringify(answers);
    }})().catch(error => {{ root.dataset.error = error.stack; }});"""
    path = folder / "page.html"
    path.write_text(text.replace("</body>", f"<script>{program}</script></body>"))
    told = browser.show(path.as_uri() + address, size)
    assert "error" not in told, told["error"]
    return json.loads(told["told"])


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


def accessible(in_browser, text):
    """Whether axe-core finds no serious and no critical fault of a page, light and dark."""
    pytest.importorskip("axe_core_python")
    program = files("axe_core_python").joinpath("axe.min.js").read_bytes()
    told = in_browser(text, AXE % base64.b64encode(program).decode())
    for passed, faults in told.values():
        assert passed > 15 and not faults, "\n".join(faults)
    return len(told) == 2


def sheets(in_browser, text):
    """How many sheets of paper a page prints on."""
    in_browser(text)
    (browser, *_) = in_browser.args
    paper = base64.b64decode(browser.ask("Page.printToPDF")["data"])
    return len(re.findall(rb"/Type\s*/Page\b", paper))
