# SPDX-License-Identifier: Apache-2.0
"""Coordinate reference systems of the map frame."""

from __future__ import annotations

from typing import Any

from quadtree_lss.desk.exchange.libraries import ExchangeError, library

WHAT = "GeoTIFF and coordinates of the Earth"


def reference(crs: str = "", origin: tuple[float, float] | None = None) -> str:
    """A coordinate reference system as WKT, empty if none is given: the map frame's, as
    ``EPSG:32611``, PROJ or WKT, or by latitude and longitude of its origin, deg, with x east and y
    north. Raises `ExchangeError`: it is none, or both are given."""
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
        with rasterio.Env():  # without it, PROJ prints what is wrong as well
            system = rasterio.crs.CRS.from_user_input(crs)
    except (rasterio.errors.CRSError, ValueError) as error:
        msg = f"'{crs}' is not a coordinate reference system: {str(error).splitlines()[0]}"
        raise ExchangeError(msg) from None
    if why := why_not_metric(system):
        msg = f"'{crs}' {why}; the map frame is in metres"
        raise ExchangeError(msg)
    return str(system.to_wkt())


def why_not_metric(system: Any) -> str:
    """Why x and y of a coordinate system (of rasterio) are no metres on a plane; empty if they are.

    One without a place on a body, as of a building site, is as good as a projected one.
    """
    unit, length = system.units_factor
    if system.is_geographic or "GEOCCS[" in system.to_wkt():
        return "is in degrees" if system.is_geographic else "is no plane"
    return "" if abs(length - 1.0) < 1e-9 else f"is in units of {unit}"
