# SPDX-License-Identifier: Apache-2.0
"""How the height of a plane over a place depends on the plane's errors."""

from __future__ import annotations

import numpy as np

from quadtree_lss.onboard.arrays import Array


def height_by_error(normal: Array, x: Array, y: Array) -> Array:
    """Derivative (K, 3) of planes' heights at x, y (K,) from their origins by their errors.

    Args:
        normal: (K, 3) upward unit normals; the errors are a tilt along the axes of Eq. 2, rad, and
            a shift along the normal, m.
        x, y: (K,) from the points that the planes are stored about, m.
    """
    nx, ny, nz = normal.T
    share, rise = 1.0 / (1.0 + nz), -(x * nx + y * ny) / nz
    along = x * nx + y * ny
    first = x - share * nx * along - nx * rise
    second = y - share * ny * along - ny * rise
    return np.asarray(np.column_stack([-first, -second, np.ones_like(x)]) / nz[:, None])
