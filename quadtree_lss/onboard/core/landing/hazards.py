# SPDX-License-Identifier: Apache-2.0
"""Avoided features of leaves (paper V.B), and the bits that say what is wrong with ground."""

from __future__ import annotations

from math import radians, tan

import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.tree.ancestors import fuse_to_level
from quadtree_lss.onboard.core.tree.cell_map import CellMap

#: A leaf with a larger share of exceptions is a hazard. Since rocks divide leaves, few are left:
#: finest ones, and all where the map is full.
MAX_EXCEPTION_FRACTION = 0.05
SLOPE, ELEVATION, EXCEPTION, TOUCHDOWN, UNCERTAIN = 1, 2, 4, 8, 16
#: The ground point is observed, but the landing zone about it is not: it cannot be judged.
PARTLY_UNOBSERVED = 32
UNMAPPED, UNSEEN = 64, 128
FEATURE = SLOPE | ELEVATION | EXCEPTION
#: Bits that say what is wrong with the ground. The others say that nobody knows: ground that is
#: seen but not yet mapped has both of them.
IDENTIFIED = FEATURE | TOUCHDOWN | UNCERTAIN


def slope(normal: Array) -> Array:
    """Eq. 54: angle in rad between normals (..., 3) and the vertical."""
    return np.arctan2(np.hypot(normal[..., 0], normal[..., 1]), normal[..., 2])


def reference_level(cells: CellMap, reference_size: float) -> int:
    """Level whose cells are nearest in size to ``reference_size`` (m), within the tree."""
    ratio = cells.domain.size / reference_size
    level = int(np.rint(np.log2(max(ratio, 1.0))))
    return min(level, cells.domain.max_level)


def avoided_features(cells: CellMap, config: LssConfig) -> Bytes:
    """Bits (M,) of the avoided features each leaf contains; unmeasured leaves have none."""
    level = reference_level(cells, config.vehicle.lengths.reference_size)
    with np.errstate(invalid="ignore"):
        east, north, up = cells.normal.T
        steep = east * east + north * north > (tan(radians(config.vehicle.max_slope_deg)) * up) ** 2
        raised = elevation_deviation(cells, level) > config.vehicle.clearance
        excepted = cells.exception_fraction > MAX_EXCEPTION_FRACTION
    bits = SLOPE * steep + ELEVATION * raised + EXCEPTION * excepted
    return np.where(cells.measured, bits, 0).astype(np.uint8)


def elevation_deviation(cells: CellMap, level: int) -> Array:
    """Greatest distance (M,), m, of each leaf's plane from the fused plane of a higher level (see
    `Ancestors.off`): 0 for leaves of the level or above, and NaN for leaves without a plane."""
    off = np.where(cells.level > level, fuse_to_level(cells, level).off, 0.0)
    return np.where(cells.estimated, off, np.nan)
