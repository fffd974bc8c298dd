# SPDX-License-Identifier: Apache-2.0
"""Avoided features of leaves (paper V.B): slope, elevation, exception."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.config.settings import LssConfig
from quadtree_lss.core.landing.ancestors import fuse_to_level
from quadtree_lss.core.tree.cell_map import CellMap

Array = NDArray[np.float64]
Bits = NDArray[np.uint8]

SLOPE, ELEVATION, EXCEPTION, TOUCHDOWN, UNSEEN = 1, 2, 4, 8, 128


def slope(normal: Array) -> Array:
    """Eq. 54: angle in rad between normals (..., 3) and the vertical."""
    return np.arctan2(np.hypot(normal[..., 0], normal[..., 1]), normal[..., 2])


def reference_level(cells: CellMap, reference_size: float) -> int:
    """Level whose cells are nearest in size to ``reference_size`` (m), within the tree."""
    ratio = cells.domain.size / reference_size
    level = int(np.rint(np.log2(max(ratio, 1.0))))
    return min(level, cells.domain.max_level)


def elevation_deviation(cells: CellMap, level: int) -> Array:
    """Greatest distance (M,), m, of each leaf's plane from the fused plane of a higher level.

    It is measured along the fused plane's normal, over the leaf's square. Both are planes, so it
    varies linearly and is greatest at a corner. 0 for leaves of the level or above, and NaN for
    leaves without a plane.
    """
    fused = fuse_to_level(cells, level)
    out = np.where(cells.estimated, 0.0, np.nan)
    chosen = np.flatnonzero((fused.of_leaf >= 0) & (cells.level > level) & cells.estimated)
    above = fused.of_leaf[chosen]
    nx, ny, nz = cells.normal[chosen].T
    x, y, z = fused.normal[above].T
    middle = x * (cells.x[chosen] - fused.x[above]) + y * (cells.y[chosen] - fused.y[above])
    middle += z * (cells.z[chosen] - fused.z[above])
    half = 0.5 * cells.size[chosen]
    out[chosen] = np.abs(middle) + half * (np.abs(x - z * nx / nz) + np.abs(y - z * ny / nz))
    return out


def avoided_features(cells: CellMap, config: LssConfig) -> Bits:
    """Bits (M,) of the avoided features each leaf contains; unmeasured leaves have none."""
    level = reference_level(cells, config.elevation_reference_size)
    with np.errstate(invalid="ignore"):
        steep = slope(cells.normal) > np.radians(config.max_slope_deg)
        raised = elevation_deviation(cells, level) > config.max_roughness
        excepted = cells.exception_fraction > config.max_exception_fraction
    bits = SLOPE * steep + ELEVATION * raised + EXCEPTION * excepted
    return np.where(cells.measured, bits, 0).astype(np.uint8)
