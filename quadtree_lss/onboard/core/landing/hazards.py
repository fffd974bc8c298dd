# SPDX-License-Identifier: Apache-2.0
"""Avoided features of leaves (paper V.B), and the planes of higher levels that elevation needs."""

from __future__ import annotations

from dataclasses import dataclass
from math import radians, tan

import cython
import numpy as np
from cython.cimports.libc.math import sqrt

from quadtree_lss.onboard.arrays import Array, Bytes, Index
from quadtree_lss.onboard.config.settings import LssConfig
from quadtree_lss.onboard.core.tree.cell_map import CellMap

if cython.compiled:
    from cython.cimports.quadtree_lss.onboard.core.geometry.plane import (
        inverse_symmetric,
        keep_up,
        shift_origin,
        turn_tangent,
    )
    from cython.cimports.quadtree_lss.onboard.core.geometry.sphere import (
        basis_at,
        minus_at,
        plus_at,
    )
else:
    from quadtree_lss.onboard.core.geometry.plane import (
        inverse_symmetric,
        keep_up,
        shift_origin,
        turn_tangent,
    )
    from quadtree_lss.onboard.core.geometry.sphere import basis_at, minus_at, plus_at

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
    """Greatest distance (M,), m, of each leaf's plane from the fused plane of a higher level.

    It is measured along the fused plane's normal, over the leaf's square. Both are planes, so it
    varies linearly and is greatest at a corner. 0 for leaves of the level or above, and NaN for
    leaves without a plane.
    """
    fused = fuse_to_level(cells, level)
    out = np.where(cells.estimated, 0.0, np.nan)
    leaf = np.flatnonzero(cells.estimated & (cells.level > level) & (fused.of_leaf >= 0))
    above = fused.of_leaf[leaf]
    (east, north, up), (x, y, z) = cells.normal[leaf].T, fused.normal[above].T
    middle = x * (cells.x[leaf] - fused.x[above]) + y * (cells.y[leaf] - fused.y[above])
    middle += z * (cells.z[leaf] - fused.z[above])
    corner = np.abs(x - z * east / up) + np.abs(y - z * north / up)
    out[leaf] = np.abs(middle) + 0.5 * cells.size[leaf] * corner
    return out


@dataclass(frozen=True)
class Ancestors:
    """Fused planes of the cells of one level that have a measured leaf below them.

    Attributes:
        level: Their level.
        cell: (A,) iy * 2^level + ix.
        x, y, z: (A,) plane's elevation z above the cell's centre, m.
        normal: (A, 3).
        range_part, pose_part: (A, 3, 3) covariance of (dphi_1, dphi_2, dd), d about (x, y, z).
        of_leaf: (M,) place of each leaf's ancestor, -1 where there is none (the leaf is of a
            higher level, or nothing below the ancestor was measured).
    """

    level: int
    cell: Index
    x: Array
    y: Array
    z: Array
    normal: Array
    range_part: Array
    pose_part: Array
    of_leaf: Index


def fuse_to_level(cells: CellMap, level: int) -> Ancestors:
    """Fuse leaves to their ancestors of ``level`` by Eq. 39-45.

    Each leaf's plane is moved to the ancestor's centre (exactly, value and covariance) and
    observes it. Range noise is independent between leaves, so the range parts weigh and average:
    E = (sum R_i^-1)^-1 sum R_i^-1 E_i. Pose error is shared, so it enters once: the mean of the
    leaves' pose parts, weighted by their measurements. Inherited planes are no information.
    Fusing children of children at once is the same as level by level, information being additive.
    """
    n = 1 << level
    below = cells.level >= level
    down = np.where(below, cells.level.astype(np.intp) - level, 0)
    key = (cells.iy.astype(np.intp) >> down) * n + (cells.ix.astype(np.intp) >> down)
    key[~below] = 0
    chosen = below & cells.measured
    place = np.full(n * n, -1, dtype=np.intp)
    place[key[chosen]] = 0
    cell = np.flatnonzero(place == 0)
    place[cell] = np.arange(len(cell))
    of_leaf = np.where(below, place[key], -1)
    size = float(cells.domain.cell_size(level))
    planes, parts = np.zeros((len(cell), 6)), np.zeros((2, len(cell), 3, 3))
    planes[:, 0] = cells.domain.xmin + (cell % n + 0.5) * size
    planes[:, 1] = cells.domain.ymin + (cell // n + 0.5) * size
    fuse_leaves(
        np.where(chosen, of_leaf, -1),
        np.column_stack([cells.x, cells.y, cells.z, cells.normal, np.maximum(cells.count, 1.0)]),
        cells.covariance_range,
        cells.covariance_pose,
        planes,
        parts,
    )
    x, y, z = planes[:, :3].T
    return Ancestors(level, cell, x, y, z, planes[:, 3:], parts[0], parts[1], of_leaf)


@cython.boundscheck(False)
@cython.locals(ancestor=cython.Py_ssize_t[::1], leaves=cython.double[:, ::1])
@cython.locals(range_part=cython.double[:, :, ::1], pose_part=cython.double[:, :, ::1])
@cython.locals(planes=cython.double[:, ::1], parts=cython.double[:, :, :, ::1])
def fuse_leaves(
    ancestor: Index, leaves: Array, range_part: Array, pose_part: Array, planes: Array, parts: Array
) -> None:
    """Fuse leaves (K) into their ancestors (A).

    Args:
        ancestor: (K,) of each leaf, 0 .. A - 1, or less where it has none.
        leaves: (K, 7) centre on each leaf's plane, m, its normal, its measurements.
        range_part, pose_part: (K, 3, 3) of their covariances.
        planes: (A, 6) x and y of the ancestors' centres, m; what is 0 is set: z and the normal.
        parts: (2, A, 3, 3) parts of their covariances, from range noise and poses; 0 before.
    """
    cython.declare(k=cython.Py_ssize_t, a=cython.Py_ssize_t, i=cython.Py_ssize_t)
    cython.declare(j=cython.Py_ssize_t)
    count: cython.Py_ssize_t = planes.shape[0]
    total = cython.declare(cython.double[::1], np.zeros(count))
    pulled = cython.declare(cython.double[:, ::1], np.zeros((count, 3)))
    own = cython.declare(cython.double[3])
    mean = cython.declare(cython.double[3])
    arm = cython.declare(cython.double[3])
    error = cython.declare(cython.double[3])
    basis = cython.declare(cython.double[6])
    turn = cython.declare(cython.double[4])
    ranges = cython.declare(cython.double[9])
    poses = cython.declare(cython.double[9])
    information = cython.declare(cython.double[9])
    with cython.nogil:
        for k in range(ancestor.shape[0]):
            a = ancestor[k]
            if a < 0:
                continue
            total[a] += leaves[k, 6]
            for i in range(2, 6):
                planes[a, i] += leaves[k, 6] * leaves[k, i]
        for a in range(count):
            planes[a, 2] /= total[a]
            length = sqrt(planes[a, 3] ** 2 + planes[a, 4] ** 2 + planes[a, 5] ** 2)
            for i in range(3, 6):
                planes[a, i] /= length
        # Each leaf seen from its ancestor's centre, its error in the tangent at the mean normal.
        for k in range(ancestor.shape[0]):
            a = ancestor[k]
            if a < 0:
                continue
            for i in range(3):
                arm[i] = planes[a, i] - leaves[k, i]
                own[i], mean[i] = leaves[k, 3 + i], planes[a, 3 + i]
                for j in range(3):
                    ranges[3 * i + j], poses[3 * i + j] = range_part[k, i, j], pose_part[k, i, j]
            basis_at(own, basis)
            minus_at(own, mean, error, turn)
            first = basis[0] * arm[0] + basis[1] * arm[1] + basis[2] * arm[2]
            second = basis[3] * arm[0] + basis[4] * arm[1] + basis[5] * arm[2]
            shift_origin(ranges, first, second)
            turn_tangent(ranges, turn)
            shift_origin(poses, first, second)
            turn_tangent(poses, turn)
            error[2] = -(own[0] * arm[0] + own[1] * arm[1] + own[2] * arm[2])
            inverse_symmetric(ranges, information)
            for i in range(3):
                for j in range(3):
                    parts[0, a, i, j] += information[3 * i + j]
                    parts[1, a, i, j] += leaves[k, 6] / total[a] * poses[3 * i + j]
                    pulled[a, i] += information[3 * i + j] * error[j]
        for a in range(count):
            for i in range(3):
                mean[i] = planes[a, 3 + i]
                for j in range(3):
                    information[3 * i + j] = parts[0, a, i, j]
                    poses[3 * i + j] = parts[1, a, i, j]
            inverse_symmetric(information, ranges)
            for i in range(3):
                error[i] = 0.0
                for j in range(3):
                    error[i] += ranges[3 * i + j] * pulled[a, j]
            plus_at(mean, error, own)
            keep_up(own)
            # d / n_z is how far the plane passes above the origin; the origin moves up to it.
            rise = error[2] / own[2]
            planes[a, 2] += rise
            shift_origin(ranges, -rise * own[0], -rise * own[1])
            shift_origin(poses, -rise * own[0], -rise * own[1])
            for i in range(3):
                planes[a, 3 + i] = own[i]
                for j in range(3):
                    parts[0, a, i, j], parts[1, a, i, j] = ranges[3 * i + j], poses[3 * i + j]
