# SPDX-License-Identifier: Apache-2.0
"""Avoided features of leaves (paper V.B): slope, elevation, exception."""

from __future__ import annotations

from math import radians, tan

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Array, Bytes, Index
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.landing.ancestors import fuse_to_level
from quadtree_lss.onboard.core.tree.cell_map import CellMap

if not cython.compiled:
    from math import fabs

#: Side of the cells of the fused plane that leaves are compared with, m: about the lander's width.
REFERENCE_SIZE = 4.0
#: A leaf with a larger share of exceptions is a hazard. Since rocks divide leaves, few are left:
#: finest ones, and all where the map is full.
MAX_EXCEPTION_FRACTION = 0.05
SLOPE, ELEVATION, EXCEPTION, TOUCHDOWN, UNCERTAIN, UNMAPPED, UNSEEN = 1, 2, 4, 8, 16, 64, 128
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


def elevation_deviation(cells: CellMap, level: int) -> Array:
    """Greatest distance (M,), m, of each leaf's plane from the fused plane of a higher level.

    It is measured along the fused plane's normal, over the leaf's square. Both are planes, so it
    varies linearly and is greatest at a corner. 0 for leaves of the level or above, and NaN for
    leaves without a plane.
    """
    fused = fuse_to_level(cells, level, with_pose=False)
    out = np.where(cells.estimated, 0.0, np.nan)
    leaves = np.column_stack([cells.x, cells.y, cells.z, 0.5 * cells.size])
    above = np.where(cells.estimated & (cells.level > level), fused.of_leaf, -1)
    planes = np.column_stack([fused.x, fused.y, fused.z])
    farthest_corner(above, leaves, cells.normal, planes, fused.normal, out)
    return out


@cython.boundscheck(False)
def farthest_corner(
    above: Index, leaves: Array, normal: Array, planes: Array, fused: Array, out: Array
) -> None:
    """Greatest distance of a leaf's plane from the fused one along that one's normal, m.

    Args:
        above: (M,) fused plane of each leaf, less than 0 for none.
        leaves: (M, 4) x, y, z of the centre and half the side, m; normal: (M, 3).
        planes: (A, 3) x, y, z of the fused planes, m; fused: (A, 3) their normals.
        out: (M,) written where there is a fused plane.
    """
    cython.declare(k=cython.Py_ssize_t, a=cython.Py_ssize_t)
    with cython.nogil:
        for k in range(above.shape[0]):
            a = above[k]
            if a < 0:
                continue
            x, y, z = fused[a, 0], fused[a, 1], fused[a, 2]
            middle = x * (leaves[k, 0] - planes[a, 0]) + y * (leaves[k, 1] - planes[a, 1])
            middle += z * (leaves[k, 2] - planes[a, 2])
            along_x = fabs(x - z * normal[k, 0] / normal[k, 2])
            along_y = fabs(y - z * normal[k, 1] / normal[k, 2])
            out[k] = fabs(middle) + leaves[k, 3] * (along_x + along_y)


def avoided_features(cells: CellMap, config: LssConfig) -> Bytes:
    """Bits (M,) of the avoided features each leaf contains; unmeasured leaves have none."""
    level = reference_level(cells, REFERENCE_SIZE)
    with np.errstate(invalid="ignore"):
        east, north, up = cells.normal.T
        steep = east * east + north * north > (tan(radians(config.max_slope_deg)) * up) ** 2
        raised = elevation_deviation(cells, level) > config.max_roughness
        excepted = cells.exception_fraction > MAX_EXCEPTION_FRACTION
    bits = SLOPE * steep + ELEVATION * raised + EXCEPTION * excepted
    return np.where(cells.measured, bits, 0).astype(np.uint8)
