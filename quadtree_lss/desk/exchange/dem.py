# SPDX-License-Identifier: Apache-2.0
"""Reading of elevation models: GeoTIFF and NPZ."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.desk.exchange.formats import ExchangeError, library, read_arrays, why_not_metric
from quadtree_lss.onboard.arrays import Array

#: GDAL driver by suffix; other drivers would open files and addresses named in the file.
DRIVERS = {".tif": "GTiff", ".tiff": "GTiff", ".img": "HFA", ".asc": "AAIGrid"}
#: Values that mean "no data" in files that do not declare it.
NO_DATA = (-9999.0, -32768.0)
#: Absolute values from here on, near the limit of single precision, also mean "no data".
NO_DATA_MAGNITUDE = 1e38
#: Largest number of posts; several arrays of 8 bytes per post are held in memory.
MAX_POSTS = 1 << 26
#: Largest height, m, which no celestial body exceeds; larger ones are undeclared "no data".
MAX_HEIGHT = 1e5
#: Smallest distance of posts and largest coordinate, m.
MIN_SPACING, MAX_COORDINATE = 1e-3, 1e8
#: Units by their names in files, m; GDAL also reads them from a vertical coordinate system.
UNITS = dict.fromkeys(("", "m", "metre", "meter", "metres", "meters"), 1.0)
UNITS |= dict.fromkeys(("ft", "foot", "feet"), 0.3048)
UNITS |= dict.fromkeys(("us survey foot", "us-ft", "us_survey_foot"), 1200.0 / 3937.0)
UNITS |= {"mm": 1e-3, "cm": 1e-2, "dm": 0.1, "km": 1e3}


@dataclass(frozen=True)
class ElevationModel:
    """Heights (ny, nx), m, NaN if unknown, at posts x (nx,), y (ny,), m, which ascend in equal
    steps; ``crs`` is the coordinate reference system as WKT, empty if unknown."""

    x: Array
    y: Array
    elevation: Array
    crs: str = ""

    def __post_init__(self) -> None:
        """Raise `ExchangeError` if the shapes do not match or x and y are not evenly spaced."""
        x, y, z = (np.asarray(of) for of in (self.x, self.y, self.elevation))
        if x.ndim != 1 or y.ndim != 1 or z.shape != (y.size, x.size):
            raise ExchangeError(f"elevation {z.shape} does not match x {x.shape} and y {y.shape}")
        step = (x[-1] - x[0]) / (x.size - 1) if x.size > 1 else 0.0
        even = all(np.allclose(np.diff(axis), step, rtol=1e-3, atol=1e-9) for axis in (x, y))
        if x.size > 1 and not (even and step > 0.0):
            raise ExchangeError("x and y must ascend in equal steps, the same for both")

    @property
    def spacing(self) -> float:
        """Distance of neighbouring posts, m."""
        return float(self.x[-1] - self.x[0]) / (len(self.x) - 1)

    def within(self, low: Array, high: Array) -> ElevationModel:
        """Return the part between two corners (2,)."""
        columns = (self.x >= low[0]) & (self.x <= high[0])
        rows = (self.y >= low[1]) & (self.y <= high[1])
        part = self.elevation[np.ix_(rows, columns)]
        return ElevationModel(self.x[columns], self.y[rows], part, self.crs)


def read_dem(path: Path) -> ElevationModel:
    """Read an elevation model: ``.npz`` with x (nx,), y (ny,), elevation (ny, nx), or a raster.

    The heights of a raster are scale * value + offset of its only band, in the unit of the band.
    Raises `ExchangeError`: the file cannot be read, is too large, has no heights, is rotated, or
    its x and y are not in m.
    """
    if not path.is_file():
        msg = f"{path}: {'a folder, not a file' if path.is_dir() else 'there is no such file'}"
        raise ExchangeError(msg)
    if path.suffix.lower() not in (".npz", *DRIVERS):
        raise ExchangeError(f"{path}: not an elevation model (.npz {' '.join(DRIVERS)})")
    model = _read_npz(path) if path.suffix.lower() == ".npz" else _read_raster(path)
    if min(len(model.x), len(model.y)) < 3 or not np.isfinite(model.elevation).any():
        msg = f"{path}: {len(model.x)} x {len(model.y)} posts with heights are too few"
        raise ExchangeError(msg)
    low, high = np.nanmin(model.elevation), np.nanmax(model.elevation)
    if not max(-low, high) <= MAX_HEIGHT:
        msg = f"{path}: heights from {low:g} to {high:g} m; declare the value that means no data"
        raise ExchangeError(msg)
    farthest = max(np.abs(axis).max() for axis in (model.x, model.y))
    if not (MIN_SPACING <= model.spacing <= MAX_HEIGHT and farthest <= MAX_COORDINATE):
        msg = f"{path}: posts {model.spacing:g} m apart, up to {farthest:g} m from the origin"
        msg += "; x and y are in m, not in degrees"
        raise ExchangeError(msg)
    return model


def _read_npz(path: Path) -> ElevationModel:
    arrays = read_arrays(path, ("x", "y", "elevation"))
    if len(arrays) < 3 or any(array.dtype.kind not in "fiu" for array in arrays.values()):
        msg = f"{path}: an elevation model has the arrays x, y and elevation, of real numbers"
        raise ExchangeError(msg)
    x, y, z = (np.asarray(arrays[name], np.float64) for name in ("x", "y", "elevation"))
    try:
        return ElevationModel(x, y, _without_no_data(z))
    except ExchangeError as error:
        raise ExchangeError(f"{path}: {error}") from None


def _without_no_data(z: Array) -> Array:
    """Replace values that mean "no data" by NaN."""
    return np.where(np.isin(z, NO_DATA) | (np.abs(z) >= NO_DATA_MAGNITUDE), np.nan, z)


def _read_raster(path: Path) -> ElevationModel:
    rasterio: Any = library("rasterio", "GeoTIFF files")
    try:
        with rasterio.open(path, driver=DRIVERS[path.suffix.lower()]) as file:
            transform, crs = file.transform, file.crs
            if file.width * file.height > MAX_POSTS:
                msg = f"{path}: {file.width} x {file.height} posts; {MAX_POSTS} is the most"
                raise ExchangeError(f"{msg} (gdal_translate -srcwin)")
            unit = (file.units[0] or "").strip()
            colours = [colour.name for colour in file.colorinterp if colour.name != "alpha"]
            kind = file.dtypes[0]
            if len(colours) != 1 or colours[0] in ("palette", "red") or "complex" in kind:
                names = ", ".join(colours)
                msg = f"{path}: not an elevation model but bands of {names} ({kind});"
                msg += " select one with gdal_translate -b"
                raise ExchangeError(msg)
            if unit.lower() not in UNITS:
                msg = f"{path}: heights are in '{unit}', which is not a known unit of length"
                raise ExchangeError(msg)
            z = _without_no_data(file.read(1, masked=True).astype(np.float64).filled(np.nan))
            z = UNITS[unit.lower()] * (file.scales[0] * z + file.offsets[0])
    except ExchangeError:
        raise
    except Exception as error:  # GDAL raises its own types
        msg = f"{path}: cannot be read: {(str(error) or type(error).__name__).splitlines()[0]}"
        raise ExchangeError(msg) from None
    if crs is not None and (why := why_not_metric(crs)):
        msg = f"{path}: {why}; convert it to metres: gdalwarp -t_srs EPSG:<a metric one>"
        raise ExchangeError(msg)
    across, along = transform.a, -transform.e
    if transform.b or transform.d or across <= 0.0 or abs(along / across - 1.0) > 1e-3:
        msg = f"{path}: its pixels are not square with north up; gdalwarp corrects that"
        raise ExchangeError(msg)
    x = transform.c + across * (np.arange(z.shape[1]) + 0.5)
    y = transform.f - along * (np.arange(z.shape[0]) + 0.5)
    return ElevationModel(x, y[::-1], z[::-1], "" if crs is None else crs.to_wkt())
