# SPDX-License-Identifier: Apache-2.0
"""Lists the measured tables and pictures of the documents: `python docs/figures.py`.

In a page a figure stands between two comments:

    <!-- figure: COMMAND
    quick; CONFIGURATION: NAMES = HASH; build BUILD, DATE -->
    <!-- end -->

HASH is of the parameters of CONFIGURATION that match NAMES. A test fails if one of them has another
default. `earlier` in place of the hash marks a figure of other defaults, and its text says so.
`--make` makes the figures of `quick` commands again. Those of `hours`, and of `idle` (an otherwise
idle computer), are made by hand.
"""

import argparse
import datetime
import fnmatch
import hashlib
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("*.md", "docs/**/*.md", "studies/*.md")
FIGURE = re.compile(
    r"<!-- figure: (?P<command>[^\n]+)\n"
    r"(?P<effort>quick|hours|idle); (?P<config>\w+): (?P<names>[^=;]+)"
    r"(?: = (?P<hash>\w{8}); build (?P<made>\w{8}, \d{4}-\d\d-\d\d)|; earlier) -->\n"
    r"(?P<body>.*?)<!-- end -->",
    re.DOTALL,
)


class Figure(NamedTuple):
    """One figure; ``hash`` and ``made`` are None if it is of an earlier build."""

    page: Path
    command: str
    effort: str
    config: str
    names: str
    hash: str | None
    made: str | None
    body: str


def figures():
    """Yield all figures, page by page."""
    for page in sorted(page for pattern in PAGES for page in ROOT.glob(pattern)):
        if not any(part.is_symlink() for part in (page, *page.parents)):
            for match in FIGURE.finditer(page.read_text(encoding="utf-8")):
                yield Figure(page, **match.groupdict())


def parameters_hash(config, names):
    """Return the hash of the parameters of a configuration that match the names."""
    from quadtree_lss.desk.replay.configuration import load_config
    from quadtree_lss.onboard.config.settings import values_from_config

    values = values_from_config(load_config([str(ROOT / "config" / f"{config}.yaml")]))
    patterns = names.split()
    used = {k: v for k, v in values.items() if any(fnmatch.fnmatch(k, p) for p in patterns)}
    return hashlib.sha256(repr(sorted(used.items())).encode()).hexdigest()[:8]


def make(figure):
    """Run the command and write what it prints, the build and the date into the page.

    A command that draws pictures prints nothing: then the text stays.
    """
    from quadtree_lss import build

    command = [sys.executable, *shlex.split(figure.command)[1:]]
    tables = {**os.environ, "TABLES": "markdown"}
    done = subprocess.run(
        command, cwd=ROOT, env=tables, stdout=subprocess.PIPE, text=True, check=True
    )
    body = done.stdout.strip() or figure.body.removeprefix("Earlier build.\n\n").strip()
    made = f"{parameters_hash(figure.config, figure.names)}; build {build.name()[:8]}"
    head = f"<!-- figure: {figure.command}\n{figure.effort}; {figure.config}: {figure.names}"
    text = figure.page.read_text(encoding="utf-8")
    start = text.index(f"<!-- figure: {figure.command}\n")
    end = text.index("<!-- end -->", start)
    new = f"{head} = {made}, {datetime.date.today()} -->\n{body}\n"
    figure.page.write_text(text[:start] + new + text[end:], encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--make", action="store_true", help="make the quick ones again")
    options = parser.parse_args()
    for figure in list(figures()):
        state = "earlier build"
        if figure.hash is not None:
            same = figure.hash == parameters_hash(figure.config, figure.names)
            state = f"build {figure.made}" + ("" if same else ", of other defaults")
        print(f"{figure.page.name}: {figure.command} ({figure.effort}; {state})", flush=True)
        if options.make and figure.effort == "quick":
            make(figure)
