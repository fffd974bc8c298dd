# SPDX-License-Identifier: Apache-2.0
"""Planes of the cells of a higher level, fused from the leaves' (paper IV.C)."""

from __future__ import annotations

from dataclasses import dataclass

import cython
import numpy as np
from cython.cimports.libc.math import sqrt

from quadtree_lss.onboard.arrays import Array, Index
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
            basis_at(mean, basis)
            plus_at(mean, basis, error, own)
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
