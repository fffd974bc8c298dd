# SPDX-License-Identifier: Apache-2.0
"""Blocks of nodes that are safe whatever the heading, found without trying one.

Over a block's window of cells let all pads stand between ``low`` and ``high`` over a reference
plane, and no ground higher than ``top`` over it. A resting plane holds both ends of a diagonal, at
c on average and not lower than the other two, and one pad of the other. At a point of the circle,
alpha and beta radii along the two diagonals, it stands at c (1 - alpha - beta) + alpha e + beta n,
with e one end and n a pad or the mirror image of one. As c <= (e + high) / 2 and
alpha + beta <= sqrt 2, with h = high - low,

    plane >= low - h (sqrt 2 - 1) / 2    and    |slope - reference slope| <= h / radius.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import LssConfig
from quadtree_lss.core.landing.lander_ground import BLOCK, LanderGround
from quadtree_lss.core.landing.touchdown_planes import ROUNDING

Single = NDArray[np.float32]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]


def surely_safe(ground: LanderGround, rows: Index, columns: Index, lss: LssConfig) -> Mask:
    """Blocks (B,), given their first nodes, all of whose nodes pass at every heading.

    Heights are of squares of two by two cells; the reference plane varies within each.
    """
    if ground.farthest > ground.radius:
        return np.zeros(len(rows), dtype=np.bool_)
    low, high = _pooled(ground.pad - ground.rise, np.minimum), _pooled(ground.top, np.maximum)
    pads = _pooled(ground.pad + ground.rise, np.maximum)
    width = (ground.window + 1) // 2
    offset = np.arange(width)
    # A block's window begins at an even row and column: the border is the reach and a block.
    corner = ((rows + BLOCK) // 2) * low.shape[1] + (columns + BLOCK) // 2
    window = corner + (offset[:, None] * low.shape[1] + offset)[..., None]
    side = np.float32(ground.side)
    x = (offset - 0.5 * (width - 1)).astype(np.float32) * (2 * side)
    bottom = low.ravel().take(window)
    norm = np.float32(width) * np.sum(x * x)
    slope_x, slope_y = x @ bottom.sum(axis=0) / norm, x @ bottom.sum(axis=1) / norm
    plane = x[:, None] * slope_x + x[:, None, None] * slope_y
    within = side * (np.abs(slope_x) + np.abs(slope_y))
    lowest = (bottom - plane).min(axis=(0, 1)) - within
    highest = (pads.ravel().take(window) - plane).max(axis=(0, 1)) + within
    top = (high.ravel().take(window) - plane).max(axis=(0, 1)) + within
    spread = highest - lowest
    sag = np.float32(0.5 * (np.sqrt(2.0) - 1.0))
    steepest = np.float32(np.tan(np.radians(lss.touchdown_slope_deg)))
    tilt = np.sqrt(slope_x * slope_x + slope_y * slope_y) + spread / np.float32(ground.radius)
    safe: Mask = top - lowest + sag * spread <= np.float32(lss.touchdown_roughness) - ROUNDING
    safe &= tilt <= steepest - ROUNDING
    return safe


def _pooled(values: Single, take: np.ufunc) -> Single:
    """Least or greatest of squares of two by two cells."""
    rows = take(values[::2], values[1::2])
    out: Single = take(rows[:, ::2], rows[:, 1::2])
    return out
