# SPDX-License-Identifier: Apache-2.0
"""Figures of the documents, and whether they are of now: `python docs/figures.py [--make]`.

In a page a figure (tables, a picture) stands between two comments:

    <!-- figure: COMMAND
    quick; CONFIGURATION: NAMES = HASH; build BUILD, DATE -->
    <!-- end -->

HASH is of the parameters whose names match NAMES, so a changed default is seen. `--make` writes
the tables of `quick` commands anew; `hours` and `idle` (needs an idle computer) are listed.
`earlier` after NAMES: an earlier build made it, and the text between the comments says so.
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
FIGURE = re.compile(
    r"<!-- figure: (?P<command>[^\n]+)\n"
    r"(?P<effort>quick|hours|idle); (?P<config>\w+): (?P<names>[^=;]+)"
    r"(?: = (?P<hash>\w{8}); build (?P<made>\w{8}, \d{4}-\d\d-\d\d)|; earlier) -->\n"
    r"(?P<body>.*?)<!-- end -->",
    re.DOTALL,
)


class Figure(NamedTuple):
    page: Path
    command: str
    effort: str
    config: str
    names: str
    hash: str | None
    made: str | None
    body: str


def figures():
    """All of them, page by page."""
    for page in sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]):
        if not any(part.is_symlink() for part in (page, *page.parents)):
            for match in FIGURE.finditer(page.read_text(encoding="utf-8")):
                yield Figure(page, **match.groupdict())


def parameters_hash(config, names):
    """Of all parameters that match, as the configuration has them."""
    from quadtree_lss.onboard.config.loading import load_config
    from quadtree_lss.onboard.config.settings import values_from_config

    values = values_from_config(load_config([str(ROOT / "config" / f"{config}.yaml")]))
    patterns = names.split()
    used = {k: v for k, v in values.items() if any(fnmatch.fnmatch(k, p) for p in patterns)}
    return hashlib.sha256(repr(sorted(used.items())).encode()).hexdigest()[:8]


def make(figure):
    """Runs the command and writes its tables, the build and the date into the page."""
    from quadtree_lss import build

    done = subprocess.run(
        [sys.executable, *shlex.split(figure.command)[1:]],
        cwd=ROOT,
        env={**os.environ, "TABLES": "markdown"},
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    body = figure.body if "--figure" in figure.command else done.stdout.strip() + "\n"
    made = f"{build.name()[:8]}, {datetime.date.today()}"
    text, old = figure.page.read_text(encoding="utf-8"), f"<!-- figure: {figure.command}\n"
    start = text.index(old)
    end = text.index("<!-- end -->", start)
    now = parameters_hash(figure.config, figure.names)
    head = f"{old}{figure.effort}; {figure.config}: {figure.names} = {now}; build {made} -->\n"
    figure.page.write_text(text[:start] + head + body + text[end:], encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--make", action="store_true", help="make the quick ones anew")
    again = parser.parse_args().make
    for figure in list(figures()):
        state = f"build {figure.made}" if figure.made else "of an earlier build"
        if figure.hash not in (None, parameters_hash(figure.config, figure.names)):
            state += ", other parameters"
        print(f"{figure.page.name}: {figure.command} ({figure.effort}; {state})", flush=True)
        if again and figure.effort == "quick":
            make(figure)
