# SPDX-License-Identifier: Apache-2.0
"""Ranked sites as GeoJSON (RFC 7946): a point and the landing zone's circle for each."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.desk.exchange.geotiff import to_degrees

CIRCLE_POINTS = 48


def sites_geojson(sites: Mapping[str, NDArray[Any]], zone: float, crs: str) -> dict[str, Any]:
    """A FeatureCollection, whose properties are of the columns' own types.

    Args:
        sites: Columns of ``sites.csv``.
        zone: Radius of the landing zone, m.
        crs: Of the map frame, as of `geotiff.reference`.
    """
    features: list[dict[str, Any]] = []
    x, y, z = (np.asarray(sites[name], np.float64) for name in "xyz")
    angles = np.linspace(0.0, 2.0 * np.pi, CIRCLE_POINTS + 1)
    for k in range(len(x)):
        known = {name: column[k] for name, column in sites.items()}
        point = _places(x[k : k + 1], y[k : k + 1], crs)[0]
        ring = _places(x[k] + zone * np.cos(angles), y[k] + zone * np.sin(angles), crs)
        ring[-1] = ring[0]
        shapes = [
            {"type": "Point", "coordinates": [*point, float(z[k])]},
            {"type": "Polygon", "coordinates": [ring]},
        ]
        for shape, kind in zip(shapes, ("site", "zone"), strict=True):
            properties = {"kind": kind, **known}
            features.append({"type": "Feature", "geometry": shape, "properties": properties})
    return {"type": "FeatureCollection", "features": features}


def _places(x: Any, y: Any, crs: str) -> list[list[float]]:
    return np.column_stack(to_degrees(x, y, crs)).tolist()
