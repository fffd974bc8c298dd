# SPDX-License-Identifier: Apache-2.0
"""``quadtree-lss export``: results for other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from quadtree_lss.desk.commands.common import DONE, add_command, named, place, print_json

FORMATS = ("geotiff", "ply", "gltf", "geojson", "map_server")
TEXT = "Write results for other programs: GeoTIFF, meshes, GeoJSON, map_server."
EXAMPLES = """examples:
  quadtree-lss export results/latest                             (all formats, into DIR/exchange)
  quadtree-lss export results/latest --format geotiff --crs EPSG:32611
  quadtree-lss export results/latest --format geojson --origin=38.46,-116.37
  quadtree-lss export results/latest --format ply --format gltf --out meshes

formats:
  geotiff      cloud-optimised GeoTIFF of every layer
  ply, gltf    the ground as a mesh in relief, green where landing is allowed
  geojson      sites and landing zones
  map_server   hazards and landing as pgm + yaml for nav2
Without --crs or --origin the map frame has no place on the Earth, and there is no GeoJSON.
"""


def add(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = add_command(commands, "export", _run, TEXT, EXAMPLES)
    add = parser.add_argument
    default = Path("results/latest")
    text = "folder that replay or sites wrote (default results/latest)"
    add("results", type=named, metavar="DIR", nargs="?", default=default, help=text)
    text = "one of these forms; may be repeated (default all)"
    add("--format", action="append", choices=FORMATS, default=[], metavar="FORM", help=text)
    add("--out", metavar="DIR", type=named, help="folder for the files (default DIR/exchange)")
    add("--crs", metavar="CRS", default="", help="coordinate system of the map frame")
    text = "latitude and longitude of the map frame's origin, deg; x is east, y north"
    add("--origin", metavar="LAT,LON", type=place, help=text)


def _run(options: argparse.Namespace) -> int:
    from quadtree_lss.desk.replay.export import export_results

    origin = None if options.origin is None else options.origin[0]
    written = export_results(
        options.results,
        options.out,
        options.format,
        crs=options.crs,
        origin=None if origin is None else (origin[0], origin[1]),
    )
    if options.json:
        print_json({"files": [str(path) for path in written]})
    else:
        names = ", ".join(path.name for path in written)
        print(f"{names}\n{len(written)} files in {written[0].parent}")
    return DONE
