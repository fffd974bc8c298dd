# SPDX-License-Identifier: Apache-2.0
"""Avoided features of leaves (paper V.B), and the bits of the hazard grid."""

from __future__ import annotations

from math import radians, tan

import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.tree.ancestors import fuse_to_level
from quadtree_lss.onboard.core.tree.cell_map import CellMap

#: Greatest share of exceptions of a leaf without a hazard. Leaves with rocks are divided, so only
#: finest leaves, and all leaves of a full map, contain exceptions.
MAX_EXCEPTION_FRACTION = 0.05
SLOPE, ELEVATION, EXCEPTION, TOUCHDOWN, UNCERTAIN = 1, 2, 4, 8, 16
#: The grid point is observed, but not the whole landing zone about it.
PARTLY_UNOBSERVED = 32
#: Observed but not estimated, and not observed; ground of the former kind has both bits.
UNMAPPED, UNSEEN = 64, 128
FEATURE = SLOPE | ELEVATION | EXCEPTION
#: Bits of identified hazards; the others mark unknown ground.
IDENTIFIED = FEATURE | TOUCHDOWN | UNCERTAIN


def slope(normal: Array) -> Array:
    """Compute the angle between normals (..., 3) and the vertical, rad (Eq. 54)."""
    return np.arctan2(np.hypot(normal[..., 0], normal[..., 1]), normal[..., 2])


def reference_level(cells: CellMap, reference_size: float) -> int:
    """Return the level whose cells are nearest in size to ``reference_size``, m."""
    ratio = cells.domain.size / reference_size
    level = int(np.rint(np.log2(max(ratio, 1.0))))
    return min(level, cells.domain.max_level)


def avoided_features(cells: CellMap, config: LssConfig) -> Bytes:
    """Return the bits (M,) of the avoided features of each leaf; 0 without own returns."""
    level = reference_level(cells, config.vehicle.lengths.reference_size)
    with np.errstate(invalid="ignore"):
        east, north, up = cells.normal.T
        steep = east * east + north * north > (tan(radians(config.vehicle.max_slope_deg)) * up) ** 2
        raised = elevation_deviation(cells, level) > config.vehicle.clearance
        excepted = cells.exception_fraction > MAX_EXCEPTION_FRACTION
    bits = SLOPE * steep + ELEVATION * raised + EXCEPTION * excepted
    return np.where(cells.measured, bits, 0).astype(np.uint8)


def elevation_deviation(cells: CellMap, level: int) -> Array:
    """Compute the greatest distance (M,) of each leaf's plane from the fused plane of its ancestor
    of ``level``, m: 0 for leaves that are not deeper, NaN without a plane."""
    off = np.where(cells.level > level, fuse_to_level(cells, level).off, 0.0)
    return np.where(cells.estimated, off, np.nan)
