# SPDX-License-Identifier: Apache-2.0
"""Export of results to other programs: layers, meshes, sites, occupancy grids."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.exchange.formats import EARTH_FILES, ExchangeError, library, reference
from quadtree_lss.desk.exchange.saved import Results, load_results
from quadtree_lss.desk.replay.files import write_bytes, write_json, writing
from quadtree_lss.desk.report.palette import SAFE_COLOUR, shaded
from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.core.landing.hazards import IDENTIFIED
from quadtree_lss.onboard.core.landing.raster import rasterise

NO_DATA = 255  # value of unseen ground in the layer ``safe``
LAYERS = {
    "elevation": ("m", "the map's own height"),
    "plane_elevation": ("m", "height of the plane at the lander's scale"),
    "slope_deg": ("deg", "slope at the lander's scale"),
    "hazard": (
        "",
        "bits that add up: 1 slope, 2 elevation, 4 exception, 8 touchdown, 16 uncertain,"
        " 64 observed but not estimated, 128 unobserved",
    ),
    "safe": ("", f"1 landing centred here is allowed, 0 it is not, {NO_DATA} unseen"),
    "score": ("1", "Eq. 59, lower is better"),
    "risk": ("1", "predicted risk of a touchdown exactly there"),
    "probability": ("1", "probability of success of aiming there"),
    "map_height": ("m", "height of the map's finest cells"),
    "map_deviation": ("m", "standard deviation of map_height"),
}
"""Unit and meaning of each layer."""
MAX_MESH_COORDINATE = 10_000.0
"""Larger coordinates lose centimetres in the 32 bits of a mesh, m."""
CIRCLE_POINTS = 48
FREE, OCCUPIED, UNKNOWN = 254, 0, 205  # grey levels of nav2's map_server


def export_results(
    results: Results | str | Path,
    out: str | Path | None = None,
    formats: Iterable[str] = (),
    *,
    crs: str = "",
    origin: tuple[float, float] | None = None,
) -> list[Path]:
    """Write results in formats of other programs; return the paths of the files.

    ``out``: folder, by default ``exchange`` in the results; ``formats``: names of `FORMATS`, by
    default all (GeoJSON only with ``crs`` or ``origin``); ``crs``: coordinate system of the map
    frame, as ``EPSG:32611``, by default that of the elevation model; ``origin``: instead, latitude
    and longitude of the map's origin, deg. Raises `ResultsError`: no results; `ExchangeError`: a
    library is missing, the coordinate system is unknown, or a file cannot be written.
    """
    found = results if isinstance(results, Results) else load_results(results)
    default = "" if origin is not None else str(found.summary.get("crs") or "")
    system = reference(crs or default, origin)
    folder = found.folder / "exchange" if out is None else Path(out)
    with writing(folder, ExchangeError):
        folder.mkdir(parents=True, exist_ok=True)
        wanted = list(formats) or [name for name in FORMATS if system or name != "geojson"]
        return [path for name in wanted for path in FORMATS[name](found, folder, system)]


def to_degrees(x: Any, y: Any, crs: str) -> list[list[float]]:
    """Convert coordinates to pairs of longitude and latitude, deg (WGS 84)."""
    rasterio = library("rasterio", EARTH_FILES)
    warp = library("rasterio.warp", EARTH_FILES)
    try:
        found = warp.transform(crs, "EPSG:4326", list(map(float, x)), list(map(float, y)))
    except (rasterio.errors.RasterioError, rasterio.errors.CRSError) as error:
        msg = f"no longitude and latitude by the coordinate system: {str(error).splitlines()[0]}"
        raise ExchangeError(msg) from None
    return np.column_stack(found[:2]).tolist()


def _geotiff(results: Results, folder: Path, crs: str) -> list[Path]:
    """Write the layers of the landing grid; height and standard deviation of the finest cells."""
    grid, domain = results.grid, results.map.domain
    written = [
        _write_geotiff(folder, name, values, grid.x, grid.y, grid.seen, crs)
        for name, values in grid.layers.items()
    ]
    middles = (np.arange(domain.finest_count) + 0.5) * domain.finest_size
    x, y = domain.xmin + middles, domain.ymin + middles
    raster = rasterise(results.map, results.config.lss)
    deviation = results.map.at(x, y[:, None]).deviation
    for name, values in (("map_height", raster.elevation), ("map_deviation", deviation)):
        known = np.where(raster.observed, values, np.nan)
        written.append(_write_geotiff(folder, name, known, x, y, raster.observed, crs))
    return written


def _write_geotiff(
    folder: Path, name: str, values: NDArray[Any], x: Array, y: Array, seen: Mask, crs: str
) -> Path:
    """Write a layer (ny, nx) as cloud-optimised GeoTIFF with pixels about x (nx,), y (ny,),
    ascending, evenly spaced, m."""
    rasterio = library("rasterio", EARTH_FILES)
    unit, description = LAYERS.get(name, ("", ""))
    integer, path = values.dtype in (np.bool_, np.uint8), folder / f"{name}.tif"
    options: dict[str, Any] = {"driver": "COG", "compress": "deflate", "crs": crs or None}
    options["nodata"] = None if integer else float("nan")
    if name == "safe":
        values, options["nodata"] = np.where(seen, values, NO_DATA), NO_DATA
    if integer:  # bits cannot be averaged
        options["overview_resampling"] = "nearest"
    pixels = np.ascontiguousarray(values[::-1], np.uint8 if integer else np.float32)
    dx, dy = (float(a[-1] - a[0]) / (len(a) - 1) if len(a) > 1 else 1.0 for a in (x, y))
    options["transform"] = rasterio.Affine(dx, 0.0, x[0] - 0.5 * dx, 0.0, -dy, y[-1] + 0.5 * dy)
    shape = {"width": len(x), "height": len(y), "count": 1, "dtype": pixels.dtype.name}
    with rasterio.MemoryFile() as content:
        with content.open(**options, **shape) as file:
            file.write(pixels, 1)
            file.units = (unit or None,)
            file.update_tags(TIFFTAG_IMAGEDESCRIPTION=f"{name}: {description}")
            file.set_band_description(1, name)
        write_bytes(path, content.read())
    return path


def _mesh(suffix: str, results: Results, folder: Path, crs: str) -> list[Path]:
    """Write the ground at the grid points in relief, green where landing is allowed, as ``ply``
    (z up) or ``glb`` (y up). Far coordinates are shifted; a text file contains the shift."""
    trimesh: Any = library("trimesh", "PLY and glTF files")
    grid, path = results.grid, folder / f"ground.{suffix}"
    heights = np.asarray(grid["elevation"], np.float64)
    vertices, faces = ground_mesh(grid.x, grid.y, heights)
    shift, written = np.zeros(3), [path]
    if len(vertices) and np.abs(vertices[:, :2]).max() > MAX_MESH_COORDINATE:
        shift[:2] = np.round(vertices[:, :2].mean(axis=0))
        written.append(folder / f"ground.{suffix}.txt")
        text = "add to x, y, z in m: {:.1f} {:.1f} {:.1f}\n".format(*shift)
        write_bytes(written[1], text.encode())
    vertices = vertices - shift
    if suffix == "glb":
        vertices = vertices[:, [0, 2, 1]] * (1.0, 1.0, -1.0)
    green = np.array(list(bytes.fromhex(SAFE_COLOUR[1:])), np.float64)
    base = np.where(grid["safe"][..., None], 0.45 * green + 120.0, 175.0)
    colours = (255.0 * shaded(base / 255.0, grid["elevation"], grid.spacing)).astype(np.uint8)
    colours = colours[np.isfinite(heights)]
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
    write_bytes(path, mesh.export(file_type=suffix))
    return written


def ground_mesh(x: Array, y: Array, heights: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return vertices (V, 3) and triangles (T, 3), counter-clockwise from above, of heights
    (ny, nx), m, at x (nx,), y (ny,); squares with a NaN corner are omitted."""
    known = np.isfinite(heights)
    number = np.cumsum(known.ravel()).reshape(known.shape) - 1
    across, along = np.meshgrid(x, y)
    vertices = np.column_stack([across[known], along[known], heights[known]])
    whole = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
    a, b = number[:-1, :-1][whole], number[:-1, 1:][whole]
    c, d = number[1:, 1:][whole], number[1:, :-1][whole]
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def _geojson(results: Results, folder: Path, crs: str) -> list[Path]:
    """Write a point and a landing zone per site (RFC 7946), with the columns of ``sites.csv``."""
    if not crs:
        raise ExchangeError("GeoJSON needs longitude and latitude: set --crs or --origin")
    features: list[dict[str, Any]] = []
    angles = np.linspace(0.0, 2.0 * np.pi, CIRCLE_POINTS + 1)
    across, along = results.zone * np.cos(angles), results.zone * np.sin(angles)
    for k, (x, y, z) in enumerate(results.positions.tolist()):
        known = {name: column[k] for name, column in results.sites.items()}
        (point,), ring = to_degrees([x], [y], crs), to_degrees(x + across, y + along, crs)
        ring[-1] = ring[0]
        shapes = {"site": ("Point", [*point, z]), "zone": ("Polygon", [ring])}
        for kind, (form, coordinates) in shapes.items():
            shape, properties = {"type": form, "coordinates": coordinates}, {"kind": kind, **known}
            features.append({"type": "Feature", "geometry": shape, "properties": properties})
    path = folder / "sites.geojson"
    write_json(path, {"type": "FeatureCollection", "features": features})
    return [path]


def _map_server(results: Results, folder: Path, crs: str) -> list[Path]:
    """Write images (PGM) and YAML files for the mode ``trinary``."""
    grid, seen, hazard = results.grid, results.grid.seen, results.grid["hazard"]
    identified = (hazard & IDENTIFIED) > 0
    maps = {
        "hazards": np.where(identified, OCCUPIED, np.where(hazard > 0, UNKNOWN, FREE)),
        "landing": np.where(grid["safe"], FREE, np.where(seen, OCCUPIED, UNKNOWN)),
    }
    written = []
    for name, values in maps.items():
        image, description = folder / f"{name}.pgm", folder / f"{name}.yaml"
        head = b"P5\n%d %d\n255\n" % (len(grid.x), len(grid.y))
        write_bytes(image, head + values[::-1].astype(np.uint8).tobytes())
        corner = [float(a[0] - 0.5 * grid.spacing) for a in (grid.x, grid.y)]
        text = f"image: {image.name}\nmode: trinary\nresolution: {grid.spacing:.9g}\n"
        text += f"origin: [{corner[0]:.9g}, {corner[1]:.9g}, 0.0]\n"
        text += "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
        write_bytes(description, text.encode())
        written += [image, description]
    return written


FORMATS: dict[str, Callable[[Results, Path, str], Any]] = {
    "geotiff": _geotiff,
    "ply": partial(_mesh, "ply"),
    "gltf": partial(_mesh, "glb"),
    "geojson": _geojson,
    "map_server": _map_server,
}
"""Writers by name of the format."""
