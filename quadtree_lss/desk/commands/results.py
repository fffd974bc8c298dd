# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss view``, ``compare`` and ``export``: use of results."""

from __future__ import annotations

import argparse
import webbrowser
from pathlib import Path

from quadtree_lss.desk.commands import common
from quadtree_lss.desk.commands.console import say
from quadtree_lss.onboard.errors import QuadtreeLssError

LATEST = Path("results/latest")
COMPARE = "Compare two results of the same ground: heights, safe ground, sites gained and lost."
COMPARE_EXAMPLES = """examples:
  quadtree-lss compare results/2026-11-20_10-00-00 results/latest
  quadtree-lss compare before after --json

They are compared at the grid points of A. Exit code 1 if they are not of the same ground.
To compare with the truth of a simulation: quadtree-lss evaluate A --truth truth.npz
"""

FORMATS = ("geotiff", "ply", "gltf", "geojson", "map_server")
EXPORT = "Write results for other programs: GeoTIFF, meshes, GeoJSON, map_server."
EXPORT_EXAMPLES = """examples:
  quadtree-lss export results/latest                             (all formats, into DIR/exchange)
  quadtree-lss export results/latest --format geotiff --crs EPSG:32611
  quadtree-lss export results/latest --format geojson --origin=38.46,-116.37
  quadtree-lss export results/latest --format ply --format gltf --out meshes

formats:
  geotiff      cloud-optimised GeoTIFF of every layer
  ply, gltf    the ground as a mesh in relief, green where landing is allowed
  geojson      sites and landing zones
  map_server   hazards and landing as pgm + yaml for nav2
GeoJSON needs --crs or --origin, which say where the map frame lies on the Earth.
"""

PAGES = ("campaign.html", "flight.html", "lander/flight.html", "report.html")
PAGES += ("evaluation/report.html", "latest/report.html")
"""Pages in order of preference: campaign, flight, demo, replay, evaluation, folder of replays."""
VIEW = "Open the page of a replay, flight, campaign or evaluation in the browser."
VIEW_EXAMPLES = """examples:
  quadtree-lss view                       (results/latest)
  quadtree-lss view flight7
  quadtree-lss view campaigns/morpheus --no-open

If the results have no page (replay --no-report), it is written.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = common.add_command(commands, "compare", _compare, COMPARE, COMPARE_EXAMPLES)
    add = parser.add_argument
    add("first", type=common.path, metavar="A", help="folder that replay or sites wrote")
    add("second", type=common.path, metavar="B", help="another one of the same ground")
    parser = common.add_command(commands, "export", _export, EXPORT, EXPORT_EXAMPLES)
    add = parser.add_argument
    text = "folder that replay or sites wrote (default results/latest)"
    add("results", type=common.path, metavar="DIR", nargs="?", default=LATEST, help=text)
    text = "one of these formats; may be repeated (default all)"
    add("--format", action="append", choices=FORMATS, default=[], metavar="FORM", help=text)
    text = "folder for the files (default DIR/exchange)"
    add("--out", metavar="DIR", type=common.path, help=text)
    add("--crs", metavar="CRS", default="", help="coordinate system of the map frame")
    text = "latitude and longitude of the map frame's origin, deg; x is east, y north"
    add("--origin", metavar="LAT,LON", type=common.origin, help=text)
    parser = common.add_command(commands, "view", _view, VIEW, VIEW_EXAMPLES)
    add = parser.add_argument
    text = "folder of a replay, flight, campaign or evaluation (default results/latest)"
    add("folder", type=common.path, metavar="DIR", nargs="?", default=LATEST, help=text)
    add("--no-open", action="store_true", help="only print the path of the page")


def _compare(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.differences import compare_results

    result = compare_results(options.first, options.second)
    common.show_result(options, result)
    if not result.same_ground:
        text = f"correlation {result.heights.correlation:.2f}, RMS {result.heights.rms:.2f} m"
        say(f"not of the same ground, or shifted: their heights differ: {text}")
        return common.ERROR
    return common.DONE


def _export(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.export import export_results

    where = {"crs": options.crs, "origin": options.origin and tuple(options.origin)}
    written = export_results(options.results, options.out, options.format, **where)
    names = ", ".join(path.name for path in written)
    text = f"{names}\n{len(written)} files in {written[0].parent}"
    common.show(options, {"files": [str(path) for path in written]}, text)
    return common.DONE


def page_in(folder: Path) -> Path:
    """Return the page of a folder; write it if there are only results. Raises `QuadtreeLssError`:
    there is nothing to show."""
    for name in PAGES:
        if (folder / name).is_file():
            return folder / name
    if not (folder / "grid.npz").is_file():
        msg = f"{folder} holds no page and no results"
        raise QuadtreeLssError(msg if folder.is_dir() else f"{folder}: no such folder")
    from quadtree_lss.desk.replay.results import write_report

    write_report(folder)
    return folder / "report.html"


def _view(options: argparse.Namespace) -> int:
    page = page_in(options.folder).resolve()
    opened = not options.no_open and webbrowser.open(page.as_uri())
    text = str(page) if opened or options.no_open else f"open {page}"
    common.show(options, {"page": str(page), "opened": bool(opened)}, text)
    return common.DONE
