# SPDX-License-Identifier: Apache-2.0
"""Points and polygons in the plane: landing areas and keep-out zones."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Coordinates over this are no place to land at, and their squares would overflow, m.
FARTHEST = 1e12


def signed_distance(polygon: ArrayLike, x: Array, y: Array) -> Array:
    """Distance in m of points from a polygon's edge, positive inside.

    Args:
        polygon: (V, 2) or (V, 3) vertices in order, V >= 3; the third column is not used.
        x, y: Coordinates of any one shape.

    Raises:
        ValueError: fewer than three vertices, or one not finite or farther out than ``FARTHEST``.
    """
    corners = np.asarray(polygon, dtype=np.float64)
    if corners.ndim != 2 or len(corners) < 3 or corners.shape[1] < 2:
        msg = f"a polygon needs three or more (x, y) vertices, got shape {corners.shape}"
        raise ValueError(msg)
    corners = corners[:, :2]
    if not (np.abs(corners) <= FARTHEST).all():
        msg = "a polygon has a vertex that is not finite or is off this world"
        raise ValueError(msg)
    inside = np.zeros(x.shape, dtype=np.bool_)
    square = np.full(x.shape, np.inf)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        ex, ey = x1 - x0, y1 - y0
        length = max(ex * ex + ey * ey, 1e-300)
        t = np.clip(((x - x0) * ex + (y - y0) * ey) / length, 0.0, 1.0)
        np.minimum(square, (x - x0 - t * ex) ** 2 + (y - y0 - t * ey) ** 2, out=square)
        if y0 != y1:
            crosses = (y0 > y) != (y1 > y)
            inside ^= crosses & (x < x0 + (y - y0) * ex / ey)
    out: Array = np.where(inside, 1.0, -1.0) * np.sqrt(square)
    return out
