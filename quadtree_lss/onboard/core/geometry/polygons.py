# SPDX-License-Identifier: Apache-2.0
"""Points and polygons in the plane: landing areas and keep-out zones."""

from __future__ import annotations

import cython
import numpy as np
from cython.cimports.libc.math import INFINITY, sqrt
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array

#: Greatest coordinate of a vertex, m: larger ones are invalid and could overflow when squared.
MAX_COORDINATE = 1e12


def signed_distance(polygon: ArrayLike, x: Array, y: Array) -> Array:
    """Compute the distance of points to the edge of a polygon, m, positive inside.

    Args:
        polygon: (V, 2) or (V, 3) vertices in order, V >= 3, m; the third column is not used.
        x, y: Coordinates of the points, of equal shape, m.

    Raises:
        ValueError: fewer than three vertices, or one not finite or beyond `MAX_COORDINATE`.
    """
    corners = np.asarray(polygon, dtype=np.float64)
    if corners.ndim != 2 or len(corners) < 3 or corners.shape[1] < 2:
        msg = f"a polygon needs three or more (x, y) vertices, got shape {corners.shape}"
        raise ValueError(msg)
    corners = corners[:, :2]
    if not (np.abs(corners) <= MAX_COORDINATE).all():
        msg = f"a polygon has a vertex that is not finite or exceeds {MAX_COORDINATE:g} m"
        raise ValueError(msg)
    edges = np.hstack([corners, np.roll(corners, -1, axis=0)])
    out = np.empty(x.shape)
    set_distances(edges, *(np.array(c, dtype=np.float64).ravel() for c in (x, y)), out.ravel())
    return out


@cython.boundscheck(False)
@cython.locals(edges=cython.double[:, ::1], x=cython.double[::1], y=cython.double[::1])
@cython.locals(out=cython.double[::1])
def set_distances(edges: Array, x: Array, y: Array, out: Array) -> None:
    """Set ``out`` (N,) to `signed_distance`; ``edges``: (V, 4) x and y of both ends, m."""
    cython.declare(i=cython.Py_ssize_t, k=cython.Py_ssize_t, inside=cython.bint)
    with cython.nogil:
        for i in range(out.shape[0]):
            inside, square = False, INFINITY
            for k in range(edges.shape[0]):
                x0, y0, y1 = edges[k, 0], edges[k, 1], edges[k, 3]
                ex, ey = edges[k, 2] - x0, y1 - y0
                dx, dy = x[i] - x0, y[i] - y0
                share = (dx * ex + dy * ey) / max(ex * ex + ey * ey, 1e-300)
                share = min(max(share, 0.0), 1.0)
                across, along = dx - share * ex, dy - share * ey
                square = min(square, across * across + along * along)
                if (y0 > y[i]) != (y1 > y[i]) and x[i] < x0 + dy * ex / ey:
                    inside = not inside
            out[i] = sqrt(square) if inside else -sqrt(square)
