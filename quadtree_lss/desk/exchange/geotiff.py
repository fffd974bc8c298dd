# SPDX-License-Identifier: Apache-2.0
"""Layers of a grid as cloud-optimised GeoTIFF, and places as coordinates of the Earth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.exchange.libraries import ExchangeError, library
from quadtree_lss.onboard.arrays import Array

WHAT = "GeoTIFF and coordinates of the Earth"


def reference(crs: str = "", origin: tuple[float, float] | None = None) -> str:
    """A coordinate reference system as WKT, empty if none is given.

    Args:
        crs: The map frame's, as ``EPSG:32611``, PROJ or WKT.
        origin: Latitude and longitude of the map frame's origin, deg, with x east and y north.

    Raises:
        ExchangeError: it is none, or both are given.
    """
    if crs and origin is not None:
        msg = "a map has either a coordinate system (crs) or an origin, not both"
        raise ExchangeError(msg)
    if origin is not None:
        latitude, longitude = origin
        crs = f"+proj=aeqd +lat_0={latitude:.9f} +lon_0={longitude:.9f} +datum=WGS84 +units=m"
    if not crs:
        return ""
    rasterio = library("rasterio", WHAT)
    try:
        return str(rasterio.crs.CRS.from_user_input(crs).to_wkt())
    except (rasterio.errors.CRSError, ValueError) as error:
        msg = f"'{crs}' is not a coordinate reference system: {str(error).splitlines()[0]}"
        raise ExchangeError(msg) from None


def write_geotiff(
    path: Path, values: NDArray[Any], x: Array, y: Array, *, crs: str = "", name: str = ""
) -> None:
    """One layer (ny, nx) of a grid; pixels are about the grid points, NaN is no data.

    Args:
        path: To write.
        values: float, uint8 or bool.
        x, y: (nx,), (ny,) of the grid points, ascending, evenly spaced, m.
        crs: As of `reference`.
        name: Description of the band.
    """
    rasterio = library("rasterio", WHAT)
    exact = values.dtype in (np.bool_, np.uint8)
    pixels = np.ascontiguousarray(values[::-1], np.uint8 if exact else np.float32)
    dx, dy = (float(a[-1] - a[0]) / (len(a) - 1) if len(a) > 1 else 1.0 for a in (x, y))
    place = rasterio.Affine(dx, 0.0, x[0] - 0.5 * dx, 0.0, -dy, y[-1] + 0.5 * dy)
    options = {"driver": "COG", "compress": "deflate", "transform": place, "crs": crs or None}
    shape = {"width": len(x), "height": len(y), "count": 1, "dtype": pixels.dtype.name}
    if not exact:
        shape["nodata"] = float("nan")
    with rasterio.open(path, "w", **options, **shape) as file:
        file.write(pixels, 1)
        if name:
            file.set_band_description(1, name)


def to_degrees(x: Array, y: Array, crs: str) -> tuple[Array, Array]:
    """Longitude and latitude of places in a coordinate reference system, deg (WGS 84)."""
    library("rasterio", WHAT)
    warp = library("rasterio.warp", WHAT)
    longitude, latitude = warp.transform(crs, "EPSG:4326", list(map(float, x)), list(map(float, y)))
    return np.array(longitude), np.array(latitude)
