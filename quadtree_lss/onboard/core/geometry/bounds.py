# SPDX-License-Identifier: Apache-2.0
"""Bounds of map values, and clamping of heights to the lowest and highest return of a leaf.

A steep plane is soon metres off beyond its returns, so every height that is computed from a leaf's
plane is clamped to these bounds. Slopes are not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array

#: Exclusive bounds of the heights and lengths of a map, m, and of its other values: their squares
#: are finite in the single precision of messages.
MAX_HEIGHT, MAX_VALUE = 1e7, 1e18
#: Bound of the heights that a map stores: the returns of a leaf lie above and below its plane.
MAX_MAP_HEIGHT = 0.95 * MAX_HEIGHT


def clamp_heights(z: Array, low: ArrayLike, high: ArrayLike) -> Array:
    """Clamp heights to [low, high]; shapes broadcast.

    A NaN bound does not limit, and a NaN height stays NaN.
    """
    z = np.where(np.less(z, low), low, z)
    return np.where(np.greater(z, high), high, z)
