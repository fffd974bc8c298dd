# SPDX-License-Identifier: Apache-2.0
"""Files of other programs: optional libraries, coordinate systems, ``.npz`` of unknown sources."""

from __future__ import annotations

import importlib
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.errors import QuadtreeLssError

MAX_BYTES = 2 << 30
"""Largest total size of the arrays of a file, because a small file may expand beyond memory."""
EARTH_FILES = "GeoTIFF and coordinates of the Earth"


class ExchangeError(QuadtreeLssError):
    """A file cannot be read or written."""


def library(name: str, what: str) -> Any:
    """Import a module of the extra ``exchange``, which ``what`` needs. Raises `ExchangeError`: it
    is not installed."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        missing = (error.name or name).partition(".")[0]
        msg = f"{what} need {missing}, which is not installed: pip install {missing}"
        raise ExchangeError(msg) from None


def read_arrays(
    path: Path, names: Collection[str] = (), kind: type[QuadtreeLssError] = ExchangeError
) -> dict[str, NDArray[Any]]:
    """Read all arrays, or those of ``names`` that exist. Raises an error of type ``kind``: the file
    does not exist, is damaged, or expands to more than `MAX_BYTES`."""
    try:
        # Memory mapping avoids reading a file with a single array, which is invalid.
        with np.load(path, mmap_mode="r", allow_pickle=False) as file:
            size = sum(part.file_size for part in file.zip.infolist())
            if size <= MAX_BYTES:
                return {name: file[name] for name in file.files if not names or name in names}
    except Exception as error:  # zipfile and NumPy raise many types on damaged files
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise kind(f"{path}: cannot be read: {why}") from None
    limit = f"the limit is {1e-9 * MAX_BYTES:.1f} GB"
    raise kind(f"{path}: its arrays have {1e-9 * size:.1f} GB; {limit}")


def reference(crs: str = "", origin: tuple[float, float] | None = None) -> str:
    """Return the coordinate reference system of the map frame as WKT, empty if none is given.

    ``crs``: as ``EPSG:32611``, PROJ or WKT; ``origin``: instead, latitude and longitude, deg, of a
    map with x east and y north. Raises `ExchangeError`: ``crs`` is invalid or not metric, or both
    are given.
    """
    if crs and origin is not None:
        raise ExchangeError("a map has either a coordinate system (crs) or an origin, not both")
    if origin is not None:
        latitude, longitude = origin
        crs = f"+proj=aeqd +lat_0={latitude:.9f} +lon_0={longitude:.9f} +datum=WGS84 +units=m"
    if not crs:
        return ""
    rasterio = library("rasterio", EARTH_FILES)
    try:
        with rasterio.Env():  # otherwise PROJ also prints its errors
            system = rasterio.crs.CRS.from_user_input(crs)
    except (rasterio.errors.CRSError, ValueError) as error:
        msg = f"'{crs}' is not a coordinate reference system: {str(error).splitlines()[0]}"
        raise ExchangeError(msg) from None
    if why := why_not_metric(system):
        raise ExchangeError(f"'{crs}' {why}; the map frame is in metres")
    return str(system.to_wkt())


def why_not_metric(system: Any) -> str:
    """Reason why x and y of a rasterio CRS are not metres on a plane; empty if they are, also in a
    local system, as of a building site."""
    unit, length = system.units_factor
    if system.is_geographic or "GEOCCS[" in system.to_wkt():
        return "is in degrees" if system.is_geographic else "is not a plane"
    return "" if abs(length - 1.0) < 1e-9 else f"is in units of {unit}"
