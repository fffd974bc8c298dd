# SPDX-License-Identifier: Apache-2.0
"""A results folder for other programs: layers, meshes, sites, occupancy grids."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.desk.exchange.geojson import sites_geojson
from quadtree_lss.desk.exchange.geotiff import check_place, write_geotiff
from quadtree_lss.desk.exchange.map_server import write_map
from quadtree_lss.desk.exchange.mesh import write_meshes
from quadtree_lss.desk.exchange.saved import Results, load_results
from quadtree_lss.desk.replay.files import plain
from quadtree_lss.onboard.arrays import Bytes
from quadtree_lss.onboard.core.landing.hazards import IDENTIFIED
from quadtree_lss.onboard.core.landing.raster import rasterise
from quadtree_lss.onboard.elevation.libraries import ExchangeError
from quadtree_lss.onboard.elevation.reference import reference

NO_DATA = 255
"""Where a layer of `MASKS` is of unseen ground."""
LAYERS = {
    "elevation": ("m", "the map's own height"),
    "plane_elevation": ("m", "height of the plane at the lander's scale"),
    "slope_deg": ("deg", "slope at the lander's scale"),
    "hazard": (
        "",
        "bits that add up: 1 slope, 2 elevation, 4 exception, 8 touchdown, 16 uncertain,"
        " 64 seen but not yet mapped, 128 unseen",
    ),
    "safe": ("", f"1 landing centred here is allowed, 0 it is not, {NO_DATA} unseen"),
    "shadow": ("", f"1 in shadow at touchdown or an hour later, 0 lit, {NO_DATA} unseen"),
    "reach": ("", f"1 within reach, 0 beyond, {NO_DATA} unseen"),
    "score": ("1", "Eq. 59, lower is better"),
    "risk": ("1", "that landing right there fails"),
    "probability": ("1", "of a safe touchdown if the lander aims there"),
    "map_height": ("m", "height of the map's finest cells"),
    "map_deviation": ("m", "standard deviation of map_height"),
}
"""Unit and meaning."""
MASKS = ("safe", "shadow", "reach")
"""Layers that are true or false."""


def export_results(
    results: Results | str | Path,
    out: str | Path | None = None,
    formats: Iterable[str] = (),
    *,
    crs: str = "",
    origin: tuple[float, float] | None = None,
) -> list[Path]:
    """Writes what a replay found in the forms of other programs; returns what was written.

    Args:
        results: Results or their folder.
        out: Folder for the files, made if missing; by default ``exchange`` in the results.
        formats: Names of `FORMATS`; none takes all, GeoJSON only with a place on the Earth.
        crs: Coordinate reference system of the map frame, as ``EPSG:32611``; by default that of the
            elevation model, if the results are of one that tells.
        origin: Instead, latitude and longitude of the map frame's origin, deg (x east, y north).

    Raises:
        ResultsError: the folder is none of results.
        ExchangeError: a library is missing, the system is none or not for that place, or nothing
            can be written.
    """
    found = results if isinstance(results, Results) else load_results(results)
    told = "" if origin is not None else str(found.summary.get("crs") or "")
    system = reference(crs or told, origin)
    if crs:
        check_place(found.grid.x[[0, -1]], found.grid.y[[0, -1]], system)
    folder = found.folder / "exchange" if out is None else Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        wanted = list(formats) or [name for name in FORMATS if system or name != "geojson"]
        return [path for name in wanted for path in FORMATS[name](found, folder, system)]
    except OSError as error:
        msg = f"{error.filename or folder}: cannot be written: {error.strerror or error}"
        raise ExchangeError(msg) from None


def _geotiff(results: Results, folder: Path, crs: str) -> list[Path]:
    """Every layer of the landing grid, and height and deviation of the map's own cells where the
    ground is known."""
    grid, domain = results.grid, results.map.domain
    layers = [(name, values, grid.x, grid.y) for name, values in grid.layers.items()]
    middles = (np.arange(domain.finest_count) + 0.5) * domain.finest_size
    x, y = domain.xmin + middles, domain.ymin + middles
    raster = rasterise(results.map, results.config.lss)
    deviation = results.map.at(x, y[:, None]).deviation
    known = (np.where(raster.seen, values, np.nan) for values in (raster.elevation, deviation))
    names = ("map_height", "map_deviation")
    layers += [(name, v, x, y) for name, v in zip(names, known, strict=True)]
    tables, written = _colour_tables(), []
    for name, values, across, along in layers:
        unit, words = LAYERS.get(name, ("", ""))
        how: dict[str, Any] = {"crs": crs, "name": name, "unit": unit, "description": words}
        if name in MASKS:
            values = np.where(grid.seen, values, NO_DATA).astype(np.uint8)
            how["nodata"] = NO_DATA
        written.append(folder / f"{name}.tif")
        write_geotiff(written[-1], values, across, along, colours=tables.get(name), **how)
    return written


def _colour_tables() -> dict[str, dict[int, str]]:
    """Colour of whole values by layer, as those of the page."""
    from quadtree_lss.desk.report import palette

    no, yes, none = palette.EXCLUDED_COLOUR, palette.SAFE_COLOUR, {NO_DATA: palette.UNSEEN_COLOUR}
    hazard = {}
    for bits in range(256):
        kinds = (colour for bit, _, colour in palette.HAZARDS if bits & bit)
        hazard[bits] = next(kinds, palette.CLEAR_COLOUR)
    tables = {"safe": {0: no, 1: yes}, "shadow": {0: yes, 1: no}, "reach": {0: no, 1: yes}}
    return {"hazard": hazard} | {name: table | none for name, table in tables.items()}


def _mesh(end: str) -> Callable[[Results, Path, str], list[Path]]:
    def write(results: Results, folder: Path, crs: str) -> list[Path]:
        """The ground at the grid points, coloured by where landing is allowed, in relief."""
        grid, path = results.grid, folder / f"ground.{end}"
        heights = np.asarray(grid["elevation"], np.float64)
        shift = write_meshes([path], grid.x, grid.y, heights, _colours(results))
        if not shift.any():
            return [path]
        note = folder / f"ground.{end}.txt"
        note.write_text("add to x, y, z in m: {:.1f} {:.1f} {:.1f}\n".format(*shift))
        return [path, note]

    return write


def _colours(results: Results) -> Bytes:
    """(ny, nx, 3): green where landing is allowed, else grey, shaded."""
    from quadtree_lss.desk.report.palette import SAFE_COLOUR
    from quadtree_lss.plot import relief

    grid = results.grid
    green = np.array(list(bytes.fromhex(SAFE_COLOUR[1:])), np.float64)
    base = np.where(grid["safe"][..., None], 0.45 * green + 120.0, 175.0)
    shade = np.nan_to_num(relief(grid["elevation"], grid.spacing), nan=0.5)
    return np.clip(base * (0.5 + shade[..., None]), 0.0, 255.0).astype(np.uint8)


def _geojson(results: Results, folder: Path, crs: str) -> list[Path]:
    lss, path = results.config.lss, folder / "sites.geojson"
    if not crs:
        msg = "GeoJSON is in longitude and latitude: --crs or --origin says where the map lies"
        raise ExchangeError(msg)
    content = plain(sites_geojson(results.sites, 0.5 * lss.vehicle.diameter + lss.margin, crs))
    path.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return [path]


def _map_server(results: Results, folder: Path, crs: str) -> list[Path]:
    grid = results.grid
    hazard, safe = np.asarray(grid["hazard"]), np.asarray(grid["safe"])
    maps = {
        "hazards": np.where((hazard & IDENTIFIED) > 0, 100, np.where(grid.seen, 0, -1)),
        "landing": np.where(safe, 0, np.where(grid.seen, 100, -1)),
    }
    written: list[Path] = []
    for name, values in maps.items():
        written += write_map(folder / name, values.astype(np.int8), grid.x, grid.y)
    return written


FORMATS: dict[str, Callable[[Results, Path, str], Any]] = {
    "geotiff": _geotiff,
    "ply": _mesh("ply"),
    "gltf": _mesh("glb"),
    "geojson": _geojson,
    "map_server": _map_server,
}
"""By name, what writes the files."""
