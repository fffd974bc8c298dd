# SPDX-License-Identifier: Apache-2.0
"""Makes the measured tables and pictures of the documents: `python docs/figures.py`.

In a page a figure stands between two comments:

    <!-- figure: COMMAND
    quick; CONFIGURATION: NAMES = HASH; build BUILD, DATE -->
    <!-- end -->

COMMAND prints the figure as Markdown, or draws its pictures. HASH is of the parameters of
CONFIGURATION that match NAMES; a test fails if one of them has another default. BUILD is a hash of
the sources of the package. `earlier` in place of hash and build marks a figure of other defaults,
and its text says so.

Without options the program lists the figures. `--make` makes those of `quick` commands in five
minutes. `--all` also makes those of `hours`, and of `idle`, which need an otherwise idle computer:
about two hours on two cores. Figures of
this build are not made again, and campaigns resume in build/evidence. Recordings and measured
terrains are in the folder QUADTREE_LSS_DATA.
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
#: In the order in which they are made.
EFFORTS = ("idle", "hours", "quick")
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


def this_build():
    """Return the first eight digits of the hash of the sources of the package."""
    from quadtree_lss.lab.campaign.study import this_build

    return this_build()[1][:8]


def is_made(figure):
    """Return whether a figure is of the defaults and of the build of the package."""
    same = figure.hash == parameters_hash(figure.config, figure.names)
    return same and figure.made.startswith(this_build())


def output_of(command):
    """Run a command of this environment; return what it prints, or None if it fails.

    Exit code 3 is of a complete table with bad outcomes, such as failed flights.
    """
    program, *words = shlex.split(command)
    first = [sys.executable] if program == "python" else [Path(sys.executable).with_name(program)]
    environment = {**os.environ, "TABLES": "markdown"}
    done = subprocess.run(
        [*first, *words], cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True
    )
    return done.stdout.strip() if done.returncode in (0, 3) else None


def write(figure, body):
    """Write the figure, the build and the date into the page.

    Pictures stay.
    """
    pictures = re.findall(r"^!\[.*?\]\(.*?\)$", figure.body, re.DOTALL | re.MULTILINE)
    body = "\n\n".join([*pictures, *([body] if body else [])])
    made = f"{parameters_hash(figure.config, figure.names)}; build {this_build()}"
    head = f"<!-- figure: {figure.command}\n{figure.effort}; {figure.config}: {figure.names}"
    text = figure.page.read_text(encoding="utf-8")
    start = text.index(f"<!-- figure: {figure.command}\n")
    end = text.index("<!-- end -->", start)
    new = f"{head} = {made}, {datetime.date.today()} -->\n{body}\n"
    figure.page.write_text(text[:start] + new + text[end:], encoding="utf-8")


def make(found):
    """Make figures, each command once; return the commands that failed or printed no table."""
    failed = []
    for command in dict.fromkeys(figure.command for figure in found):
        print(f"making: {command}", flush=True)
        body, same = output_of(command), [figure for figure in found if figure.command == command]
        shows_table = any("\n| --- |" in figure.body for figure in same)
        if body is None or (shows_table and "| --- |" not in body):
            print(body or "", flush=True)
            failed.append(command)
            continue
        for figure in same:
            write(figure, body)
    return failed


def main():
    """List the figures, or make them."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--make", action="store_true", help="make the quick ones")
    parser.add_argument("--all", action="store_true", help="make all that this build has not made")
    options = parser.parse_args()
    found = sorted(figures(), key=lambda figure: EFFORTS.index(figure.effort))
    for figure in found:
        state = "earlier build"
        if figure.hash is not None:
            same = figure.hash == parameters_hash(figure.config, figure.names)
            state = f"build {figure.made}" + ("" if same else ", of other defaults")
        print(f"{figure.page.name}: {figure.command} ({figure.effort}; {state})", flush=True)
    chosen = [
        figure
        for figure in found
        if figure.effort == "quick" or (options.all and not is_made(figure))
    ]
    failed = make(chosen) if options.make or options.all else []
    for command in failed:
        print(f"not made: {command}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
