# SPDX-License-Identifier: Apache-2.0
"""``prior.file``: an elevation model laid into the map frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.tree.prior import Prior
from quadtree_lss.onboard.elevation.dem import ElevationModel, read_dem
from quadtree_lss.onboard.elevation.libraries import ExchangeError, library
from quadtree_lss.onboard.elevation.reference import WHAT, reference

#: Posts along a side that a model is given about the origin, at most, and beyond a square that
#: follows.
MOST, BEYOND = 1024, 256


def read_prior(config: Config, path: Path | None = None) -> Prior | None:
    """The prior of a configuration, None without ``prior.file``.

    Its heights are in m whatever the file's unit. Without ``prior.origin`` its x and y are the
    map's; with it they are those of the plane about that place, x east and y north, as of
    ``export --origin``. ``path``: the file, if not by its name. Raises `ExchangeError`: the file
    cannot be read, is no elevation model, of a unit that is not known, or without a place where it
    needs one; or a library lacks, by name.
    """
    if not config.prior.file:
        return None
    path = Path(config.prior.file) if path is None else path
    model = read_dem(path)
    if config.prior.origin:
        model = _about(model, config, path)
    return Prior(model.x, model.y, model.elevation, config.prior)


def _about(model: ElevationModel, config: Config, path: Path) -> ElevationModel:
    """A model about the map's origin, with the posts' spacing, as far as the map reaches."""
    from scipy.ndimage import map_coordinates

    try:
        latitude, longitude = (float(part) for part in config.prior.origin.split(","))
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 360.0):
            raise ValueError
    except ValueError:
        msg = f"prior.origin: '{config.prior.origin}' is no LAT,LON in degrees"
        raise ExchangeError(msg) from None
    if not model.crs:
        msg = f"{path}: has no coordinate system by which prior.origin could place it"
        raise ExchangeError(msg)
    domain, room = config.domain, 4.0 * config.prior.offset_sigma + 8.0 * model.spacing
    if domain.follow != "none":
        room += BEYOND * model.spacing
    step = max(model.spacing, (domain.size + 2.0 * room) / (MOST - 2))
    low = np.floor((np.array([domain.xmin, domain.ymin]) - room) / step)
    count = int((domain.size + 2.0 * room) / step) + 2
    x, y = (step * (start + np.arange(count)) for start in low)
    warp = library("rasterio.warp", WHAT)
    at = np.meshgrid(x, y)
    places = warp.transform(
        reference("", (latitude, longitude)), model.crs, *(axis.ravel().tolist() for axis in at)
    )
    column, row = (
        (np.asarray(place) - axis[0]) / model.spacing
        for place, axis in zip(places, (model.x, model.y), strict=True)
    )
    z = map_coordinates(model.elevation, np.stack([row, column]), order=1, cval=np.nan)
    return ElevationModel(x, y, z.reshape(count, count), model.crs)
