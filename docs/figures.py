# SPDX-License-Identifier: Apache-2.0
"""Figures of the documents, and whether they are of now: `python docs/figures.py`.

In a page a figure (tables, a picture) stands between two comments:

    <!-- figure: COMMAND
    quick; CONFIGURATION: NAMES = HASH; build BUILD, DATE -->
    <!-- end -->

HASH is of the parameters whose names match NAMES, so a changed default is seen. `--make` writes
the tables of `quick` commands anew; `hours` and `idle` (needs an idle computer) are listed.
`--earlier` marks what has other parameters by now: `earlier` after NAMES, and a note for readers.
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
    from quadtree_lss.desk.replay.configuration import load_config
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
    made = f"build {build.name()[:8]}, {datetime.date.today()}"
    write(figure, made, None if "--figure" in figure.command else done.stdout.strip() + "\n")


def write(figure, made, body=None):
    """Replaces a figure's head, and its body or the note that an earlier build made it."""
    if made:
        made = f" = {parameters_hash(figure.config, figure.names)}; {made}"
    bare = re.sub(r"\AEarlier build.*?\n\n", "", figure.body, flags=re.DOTALL)
    body = body or ("" if made else "Earlier build.\n\n") + bare
    text, head = figure.page.read_text(encoding="utf-8"), f"<!-- figure: {figure.command}\n"
    start = text.index(head)
    end = text.index("<!-- end -->", start)
    head += f"{figure.effort}; {figure.config}: {figure.names}{made or '; earlier'} -->\n"
    figure.page.write_text(text[:start] + head + body + text[end:], encoding="utf-8")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--make", action="store_true", help="make the quick ones anew")
    parser.add_argument("--earlier", action="store_true", help="mark those of other parameters")
    options = parser.parse_args()
    for figure in list(figures()):
        stale = figure.hash not in (None, parameters_hash(figure.config, figure.names))
        state = f"build {figure.made}" if figure.made else "of an earlier build"
        state += ", of other parameters" if stale else ""
        print(f"{figure.page.name}: {figure.command} ({figure.effort}; {state})", flush=True)
        if options.make and figure.effort == "quick":
            make(figure)
        elif options.earlier and stale:
            write(figure, None)
