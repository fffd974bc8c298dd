# SPDX-License-Identifier: Apache-2.0
"""Coordinate reference systems of the map frame."""

from __future__ import annotations

from typing import Any

from quadtree_lss.desk.exchange.libraries import ExchangeError, library

EXPORTS_NEEDING_CRS = "GeoTIFF and coordinates of the Earth"


def reference(crs: str = "", origin: tuple[float, float] | None = None) -> str:
    """Return the coordinate reference system of the map frame as WKT, empty if none is given.

    Args:
        crs: The system as ``EPSG:32611``, PROJ or WKT.
        origin: Instead of ``crs``, latitude and longitude of the origin, deg; x points east and y
            north.

    Raises `ExchangeError`: ``crs`` is invalid or not metric, or both are given.
    """
    if crs and origin is not None:
        msg = "a map has either a coordinate system (crs) or an origin, not both"
        raise ExchangeError(msg)
    if origin is not None:
        latitude, longitude = origin
        crs = f"+proj=aeqd +lat_0={latitude:.9f} +lon_0={longitude:.9f} +datum=WGS84 +units=m"
    if not crs:
        return ""
    rasterio = library("rasterio", EXPORTS_NEEDING_CRS)
    try:
        with rasterio.Env():  # otherwise PROJ also prints its errors
            system = rasterio.crs.CRS.from_user_input(crs)
    except (rasterio.errors.CRSError, ValueError) as error:
        msg = f"'{crs}' is not a coordinate reference system: {str(error).splitlines()[0]}"
        raise ExchangeError(msg) from None
    if why := why_not_metric(system):
        msg = f"'{crs}' {why}; the map frame is in metres"
        raise ExchangeError(msg)
    return str(system.to_wkt())


def why_not_metric(system: Any) -> str:
    """Reason why x and y of a rasterio CRS are not metres on a plane; empty if they are.

    A local system without a place on a body, as of a building site, is accepted.
    """
    unit, length = system.units_factor
    if system.is_geographic or "GEOCCS[" in system.to_wkt():
        return "is in degrees" if system.is_geographic else "is not a plane"
    return "" if abs(length - 1.0) < 1e-9 else f"is in units of {unit}"
