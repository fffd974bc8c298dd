# SPDX-License-Identifier: Apache-2.0
"""Avoided features of leaves (paper V.B), and the bits of the hazard grid."""

from __future__ import annotations

from math import radians, tan

import numpy as np

from quadtree_lss.onboard.arrays import Bytes
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


def avoided_features(cells: CellMap, config: LssConfig) -> Bytes:
    """Return the bits (M,) of the avoided features of each leaf; 0 without own returns."""
    ratio = cells.domain.size / config.vehicle.lengths.reference_size
    level = min(int(np.rint(np.log2(max(ratio, 1.0)))), cells.domain.max_level)
    # Greatest distance of each leaf's plane from the fused plane of its ancestor, m.
    off = np.where(cells.level > level, fuse_to_level(cells, level).off, 0.0)
    with np.errstate(invalid="ignore"):
        east, north, up = cells.normal.T
        steep = east * east + north * north > (tan(radians(config.vehicle.max_slope_deg)) * up) ** 2
        raised = off > config.vehicle.clearance
        excepted = cells.exception_fraction > MAX_EXCEPTION_FRACTION
    bits = SLOPE * steep + ELEVATION * raised + EXCEPTION * excepted
    return np.where(cells.measured, bits, 0).astype(np.uint8)
