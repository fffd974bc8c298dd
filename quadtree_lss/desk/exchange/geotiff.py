# SPDX-License-Identifier: Apache-2.0
"""Layers of a grid as cloud-optimised GeoTIFF, and places as coordinates of the Earth."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.elevation.libraries import ExchangeError, library
from quadtree_lss.onboard.elevation.reference import WHAT

FARTHEST_DEG = 1.0
"""Beyond the area of a coordinate system; neighbouring zones of UTM are used so."""


def check_place(x: Array, y: Array, crs: str) -> None:
    """See that places in m lie in the area that a coordinate system is made for.

    Systems that name no area, as those about an origin, have none.

    Raises:
        ExchangeError: they are farther from it than a degree, at which its metres are wrong.
    """
    rasterio = library("rasterio", WHAT)
    system = rasterio.crs.CRS.from_wkt(crs)
    code = system.to_epsg()
    known = rasterio.crs.CRS.from_epsg(code) if code else system
    area = re.search(r"BBOX\[(.*?)\]", known.to_wkt(version="WKT2_2019"))
    if area is None:
        return
    south, west, north, east = map(float, area[1].split(","))
    longitude, latitude = to_degrees(x, y, crs)
    inside = (longitude - west) % 360.0 <= ((east - west) % 360.0 or 360.0)
    aside = np.minimum((longitude - east) % 360.0, (west - longitude) % 360.0)
    beyond = np.where(inside, 0.0, aside)
    off = np.max([beyond, south - latitude, latitude - north])
    if not off <= FARTHEST_DEG:
        msg = (
            f"the map lies at latitude {latitude[0]:.2f}, longitude {longitude[0]:.2f} by its"
            f" coordinate system, which is for {area[1]} (south, west, north, east):"
            " a map about a place has --origin instead"
        )
        raise ExchangeError(msg)


def write_geotiff(
    path: Path,
    values: NDArray[Any],
    x: Array,
    y: Array,
    *,
    crs: str = "",
    name: str = "",
    unit: str = "",
    description: str = "",
    colours: Mapping[int, str] | None = None,
    nodata: int | None = None,
) -> None:
    """One layer (ny, nx) of a grid; pixels are about the grid points, NaN is no data.

    Args:
        path: To write.
        values: float, uint8 or bool.
        x, y: (nx,), (ny,) of the grid points, ascending, evenly spaced, m.
        crs: As of `reference`.
        name, unit: Of the band.
        description: Of the file.
        colours: ``#rrggbb`` of values, of uint8.
        nodata: The value that means none, of uint8.
    """
    rasterio = library("rasterio", WHAT)
    exact = values.dtype in (np.bool_, np.uint8)
    pixels = np.ascontiguousarray(values[::-1], np.uint8 if exact else np.float32)
    dx, dy = (float(a[-1] - a[0]) / (len(a) - 1) if len(a) > 1 else 1.0 for a in (x, y))
    place = rasterio.Affine(dx, 0.0, x[0] - 0.5 * dx, 0.0, -dy, y[-1] + 0.5 * dy)
    options = {"driver": "COG", "compress": "deflate", "transform": place, "crs": crs or None}
    shape = {"width": len(x), "height": len(y), "count": 1, "dtype": pixels.dtype.name}
    shape["nodata"] = nodata if exact else float("nan")
    if exact:  # a mean of bits is none of them
        options["overview_resampling"] = "nearest"
    with rasterio.open(path, "w", **options, **shape) as file:
        file.write(pixels, 1)
        file.units = (unit or None,)
        file.update_tags(TIFFTAG_IMAGEDESCRIPTION=f"{name}: {description}")
        if colours:
            shades = {value: bytes.fromhex(text[1:]) for value, text in colours.items()}
            file.write_colormap(1, {value: tuple(shade) for value, shade in shades.items()})
        if name:
            file.set_band_description(1, name)


def to_degrees(x: Array, y: Array, crs: str) -> tuple[Array, Array]:
    """Longitude and latitude of places in a coordinate reference system, deg (WGS 84).

    Raises:
        ExchangeError: the system has no place on the Earth.
    """
    rasterio = library("rasterio", WHAT)
    warp = library("rasterio.warp", WHAT)
    try:
        found = warp.transform(crs, "EPSG:4326", list(map(float, x)), list(map(float, y)))
    except (rasterio.errors.RasterioError, rasterio.errors.CRSError) as error:
        msg = f"no longitude and latitude by the coordinate system: {str(error).splitlines()[0]}"
        raise ExchangeError(msg) from None
    return np.array(found[0]), np.array(found[1])
