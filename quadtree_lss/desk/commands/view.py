# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss view``: the page of whatever is in a folder."""

from __future__ import annotations

import argparse
import webbrowser
from pathlib import Path

from quadtree_lss.desk.commands.common import DONE, add_command, named, print_json
from quadtree_lss.onboard.errors import QuadtreeLssError

PAGES = ("campaign.html", "flight.html", "lander/flight.html", "report.html")
PAGES += ("evaluation/report.html", "latest/report.html")
"""Of a campaign, a flight, the demo, a replay, an evaluation, a folder of replays; the first."""
TEXT = "Open the page of a replay, flight, campaign or evaluation in the browser."
EXAMPLES = """examples:
  quadtree-lss view                       (results/latest)
  quadtree-lss view flight7
  quadtree-lss view campaigns/morpheus --no-open

Of results without a page (replay --no-report) the page is made.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = add_command(commands, "view", _run, TEXT, EXAMPLES)
    default = Path("results/latest")
    text = "folder of a replay, flight, campaign or evaluation (default results/latest)"
    parser.add_argument("folder", type=named, metavar="DIR", nargs="?", default=default, help=text)
    parser.add_argument("--no-open", action="store_true", help="only print where the page is")


def page_in(folder: Path) -> Path:
    """The page of what is in a folder, made where there are only results.

    Raises:
        QuadtreeLssError: there is nothing to be shown.
    """
    for name in PAGES:
        if (folder / name).is_file():
            return folder / name
    if not (folder / "grid.npz").is_file():
        msg = f"{folder} holds no page and no results"
        raise QuadtreeLssError(msg if folder.is_dir() else f"{folder}: no such folder")
    from quadtree_lss.desk.replay.results import write_report

    write_report(folder)
    return folder / "report.html"


def _run(options: argparse.Namespace) -> int:
    page = page_in(options.folder).resolve()
    opened = not options.no_open and webbrowser.open(page.as_uri())
    if options.json:
        print_json({"page": str(page), "opened": bool(opened)})
    else:
        print(str(page) if opened or options.no_open else f"open {page}")
    return DONE
