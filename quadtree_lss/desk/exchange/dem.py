# SPDX-License-Identifier: Apache-2.0
"""Elevation models from files: GeoTIFF and NPZ."""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from quadtree_lss.desk.exchange.libraries import ExchangeError, library
from quadtree_lss.onboard.arrays import Array

TIFF = (".tif", ".tiff", ".vrt", ".img", ".asc")


@dataclass(frozen=True)
class ElevationModel:
    """Heights at posts.

    Attributes:
        x, y: (nx,), (ny,) ascending, evenly spaced alike, m.
        elevation: (ny, nx) m, NaN where it is not known.
        crs: Coordinate reference system as WKT, empty if it is not told.
    """

    x: Array
    y: Array
    elevation: Array
    crs: str = ""

    @property
    def spacing(self) -> float:
        """Distance of neighbouring posts, m."""
        return float(self.x[-1] - self.x[0]) / (len(self.x) - 1)

    def within(self, low: Array, high: Array) -> ElevationModel:
        """The posts in a rectangle between corners (2,)."""
        columns = (self.x >= low[0]) & (self.x <= high[0])
        rows = (self.y >= low[1]) & (self.y <= high[1])
        part = self.elevation[np.ix_(rows, columns)]
        return ElevationModel(self.x[columns], self.y[rows], part, self.crs)


def read_dem(path: Path) -> ElevationModel:
    """An elevation model: ``.npz`` with x (nx,), y (ny,), elevation (ny, nx), or what GDAL reads.

    Raises:
        ExchangeError: the file cannot be read, is in degrees or feet, or turned.
    """
    if not path.is_file():
        msg = f"{path}: there is no such file"
        raise ExchangeError(msg)
    read = _npz if path.suffix.lower() == ".npz" else _raster
    if read is _raster and path.suffix.lower() not in TIFF:
        msg = f"{path}: not an elevation model (.npz {' '.join(TIFF)})"
        raise ExchangeError(msg)
    model = read(path)
    if min(len(model.x), len(model.y)) < 3 or not np.isfinite(model.elevation).any():
        msg = f"{path}: {len(model.x)} x {len(model.y)} posts with heights are too few"
        raise ExchangeError(msg)
    return model


def _npz(path: Path) -> ElevationModel:
    try:
        with np.load(path, allow_pickle=False) as file:
            x, y, z = (np.asarray(file[name], np.float64) for name in ("x", "y", "elevation"))
    except KeyError:
        msg = f"{path}: an elevation model has the arrays x, y and elevation"
        raise ExchangeError(msg) from None
    except (OSError, ValueError, TypeError, EOFError, AttributeError) as error:
        msg = f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}"
        raise ExchangeError(msg) from None
    except (zipfile.BadZipFile, zlib.error) as error:
        msg = f"{path}: cannot be read: {error}"
        raise ExchangeError(msg) from None
    if x.ndim != 1 or y.ndim != 1 or z.shape != (y.size, x.size) or min(x.size, y.size) < 2:
        msg = f"{path}: elevation {z.shape} does not belong to x {x.shape} and y {y.shape}"
        raise ExchangeError(msg)
    step = float(x[-1] - x[0]) / (x.size - 1)
    even = all(np.allclose(np.diff(axis), step, rtol=1e-3, atol=1e-9) for axis in (x, y))
    if not (even and step > 0.0):
        msg = f"{path}: x and y must ascend in equal steps, both alike"
        raise ExchangeError(msg)
    return ElevationModel(x, y, z)


def _raster(path: Path) -> ElevationModel:
    rasterio: Any = library("rasterio", "GeoTIFF files")
    try:
        with rasterio.open(path) as file:
            transform, crs = file.transform, file.crs
            z = file.read(1, masked=True).astype(np.float64).filled(np.nan)
    except rasterio.errors.RasterioError as error:
        msg = f"{path}: cannot be read: {str(error).splitlines()[0]}"
        raise ExchangeError(msg) from None
    if crs is not None and crs.is_geographic:
        msg = (
            f"{path}: is in degrees; bring it to metres first: gdalwarp -t_srs EPSG:<a metric one>"
        )
        raise ExchangeError(msg)
    if crs is not None and crs.is_projected and abs(crs.linear_units_factor[1] - 1.0) > 1e-9:
        msg = f"{path}: is in {crs.linear_units}; bring it to metres first: gdalwarp -t_srs EPSG:…"
        raise ExchangeError(msg)
    across, along = transform.a, -transform.e
    if transform.b or transform.d or across <= 0.0 or abs(along / across - 1.0) > 1e-3:
        msg = f"{path}: its pixels are not square with north up: gdalwarp makes them so"
        raise ExchangeError(msg)
    x = transform.c + across * (np.arange(z.shape[1]) + 0.5)
    y = transform.f - along * (np.arange(z.shape[0]) + 0.5)
    return ElevationModel(x, y[::-1], z[::-1], "" if crs is None else crs.to_wkt())
