# SPDX-License-Identifier: Apache-2.0
"""Planes of higher levels, fused from the leaves below them (paper IV.B, IV.C)."""

from __future__ import annotations

from dataclasses import dataclass

import cython
import numpy as np

from quadtree_lss.onboard.arrays import Array, Index
from quadtree_lss.onboard.core.tree.cell_map import CellMap

if not cython.compiled:
    from math import sqrt

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


def fuse_to_level(cells: CellMap, level: int, *, with_pose: bool = True) -> Ancestors:
    """Fuse leaves to their ancestors of ``level`` by Eq. 39-45.

    Each leaf's plane is moved to the ancestor's centre (exactly, value and covariance) and
    observes it. Range noise is independent between leaves, so the range parts weigh and average:
    E = (sum R_i^-1)^-1 sum R_i^-1 E_i. Pose error is shared, so it enters once: the mean of the
    leaves' pose parts, weighted by their measurements. Inherited planes are no information.
    Fusing children of children at once is the same as level by level, information being additive.
    Without ``with_pose`` there are no pose parts (0, 3, 3): the planes do not need them.
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
    size = float(cells.domain.cell_size(level))
    out = Ancestors(
        level=level,
        cell=cell,
        x=np.asarray(cells.domain.xmin + (cell % n + 0.5) * size, dtype=np.float64),
        y=np.asarray(cells.domain.ymin + (cell // n + 0.5) * size, dtype=np.float64),
        z=np.zeros(len(cell)),
        normal=np.zeros((len(cell), 3)),
        range_part=np.zeros((len(cell), 3, 3)),
        pose_part=np.zeros((len(cell) if with_pose else 0, 3, 3)),
        of_leaf=np.where(below, place[key], -1),
    )
    fuse_leaves(
        np.where(chosen, out.of_leaf, -1),
        np.column_stack([cells.x, cells.y, cells.z]),
        cells.normal,
        cells.covariance_range,
        cells.covariance_pose,
        np.maximum(cells.count, 1.0),
        np.column_stack([out.x, out.y]),
        out.z,
        out.normal,
        out.range_part,
        out.pose_part,
    )
    return out


@cython.boundscheck(False)
def fuse_leaves(
    ancestor: Index,
    centre: Array,
    normal: Array,
    range_part: Array,
    pose_part: Array,
    weight: Array,
    place: Array,
    z: Array,
    fused: Array,
    fused_range: Array,
    fused_pose: Array,
) -> None:
    """Fuse leaves (K) into their ancestors (A); what is fused is zero before.

    Args:
        ancestor: (K,) of each leaf, 0 .. A - 1, or less where it has none.
        centre: (K, 3) on each leaf's plane, m.
        normal, range_part, pose_part: (K, 3), (K, 3, 3), (K, 3, 3).
        weight: (K,) measurements.
        place: (A, 2) x and y of the ancestors' centres, m.
        z, fused, fused_range, fused_pose: What is made of them: (A,), (A, 3), (A, 3, 3) twice, the
            last only if it is not empty.
    """
    cython.declare(k=cython.Py_ssize_t, a=cython.Py_ssize_t, i=cython.Py_ssize_t)
    cython.declare(j=cython.Py_ssize_t)
    count: cython.Py_ssize_t = place.shape[0]
    with_pose: cython.bint = fused_pose.shape[0] > 0
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
            total[a] += weight[k]
            z[a] += weight[k] * centre[k, 2]
            for i in range(3):
                fused[a, i] += weight[k] * normal[k, i]
        for a in range(count):
            z[a] /= total[a]
            length = sqrt(fused[a, 0] ** 2 + fused[a, 1] ** 2 + fused[a, 2] ** 2)
            for i in range(3):
                fused[a, i] /= length
        # Each leaf seen from its ancestor's centre, its error in the tangent at the mean normal.
        for k in range(ancestor.shape[0]):
            a = ancestor[k]
            if a < 0:
                continue
            arm[0], arm[1] = place[a, 0] - centre[k, 0], place[a, 1] - centre[k, 1]
            arm[2] = z[a] - centre[k, 2]
            for i in range(3):
                own[i], mean[i] = normal[k, i], fused[a, i]
                for j in range(3):
                    ranges[3 * i + j] = range_part[k, i, j]
                    if with_pose:
                        poses[3 * i + j] = pose_part[k, i, j]
            basis_at(own, basis)
            minus_at(own, mean, error, turn)
            first = basis[0] * arm[0] + basis[1] * arm[1] + basis[2] * arm[2]
            second = basis[3] * arm[0] + basis[4] * arm[1] + basis[5] * arm[2]
            shift_origin(ranges, first, second)
            turn_tangent(ranges, turn)
            if with_pose:
                shift_origin(poses, first, second)
                turn_tangent(poses, turn)
            error[2] = -(own[0] * arm[0] + own[1] * arm[1] + own[2] * arm[2])
            inverse_symmetric(ranges, information)
            for i in range(3):
                for j in range(3):
                    fused_range[a, i, j] += information[3 * i + j]
                    if with_pose:
                        fused_pose[a, i, j] += weight[k] / total[a] * poses[3 * i + j]
                    pulled[a, i] += information[3 * i + j] * error[j]
        for a in range(count):
            for i in range(3):
                mean[i] = fused[a, i]
                for j in range(3):
                    information[3 * i + j] = fused_range[a, i, j]
                    if with_pose:
                        poses[3 * i + j] = fused_pose[a, i, j]
            inverse_symmetric(information, ranges)
            for i in range(3):
                error[i] = 0.0
                for j in range(3):
                    error[i] += ranges[3 * i + j] * pulled[a, j]
            plus_at(mean, error, own)
            keep_up(own)
            # d / n_z is how far the plane passes above the origin; the origin moves up to it.
            rise = error[2] / own[2]
            z[a] += rise
            shift_origin(ranges, -rise * own[0], -rise * own[1])
            if with_pose:
                shift_origin(poses, -rise * own[0], -rise * own[1])
            for i in range(3):
                fused[a, i] = own[i]
                for j in range(3):
                    fused_range[a, i, j] = ranges[3 * i + j]
                    if with_pose:
                        fused_pose[a, i, j] = poses[3 * i + j]
