# SPDX-License-Identifier: Apache-2.0
"""Planes of the cells of a higher level, fused from the leaves' (paper IV.C)."""

from __future__ import annotations

from typing import NamedTuple

import cython
import numpy as np
from cython.cimports.quadtree_lss.onboard.core.geometry import plane
from cython.cimports.quadtree_lss.onboard.core.geometry.sphere import basis_at, minus_at, plus_at

from quadtree_lss.onboard.arrays import Array, Index
from quadtree_lss.onboard.core.tree.cell_map import CellMap


class Ancestors(NamedTuple):
    """Fused planes of the cells of one level that have a measured leaf below them.

    Attributes:
        cell: (A,) iy * 2^level + ix.
        planes: (A, 6) x, y, z: elevation z above the cell's centre, m; upward unit normal.
        range_part: (A, 3, 3) covariance of (dphi_1, dphi_2, dd), d about (x, y, z), from range
            noise.
        of_leaf: (M,) row of each leaf's ancestor, -1 where there is none (the leaf is of a higher
            level, or no leaf below the ancestor was measured).
        off: (M,) greatest distance of each leaf's plane from its ancestor's, along the normal of
            that, over the leaf's square, m; 0 where there is none.
    """

    cell: Index
    planes: Array
    range_part: Array
    of_leaf: Index
    off: Array


def fuse_to_level(cells: CellMap, level: int) -> Ancestors:
    """Fuse leaves to their ancestors of ``level`` by Eq. 39-45.

    Each leaf's plane is moved to the ancestor's centre (exactly, value and covariance) and
    observes it. Range noise is independent between leaves, so the range parts weigh and average:
    E = (sum R_i^-1)^-1 sum R_i^-1 E_i. Pose error is common and has no weight. Inherited planes
    are no information. Information is additive, so this is the same as level by level.
    """
    n, below = 1 << level, cells.level >= level
    down = np.where(below, cells.level, level) - level
    over = (cells.iy.astype(np.intp) >> down << level) + (cells.ix >> down)
    row = np.full(n * n, -1, dtype=np.intp)
    row[over[below & cells.measured]] = 0
    cell = np.flatnonzero(row == 0)
    row[cell] = np.arange(len(cell))
    of_leaf = np.where(below, row[over], -1)
    leaf = np.flatnonzero(below & cells.measured)
    ancestor = of_leaf[leaf]
    leaves = np.stack([cells.x, cells.y, cells.z, *cells.normal.T])
    # Linearised about the mean of the leaves.
    weight = np.maximum(cells.count[leaf], 1.0)
    mean = [np.bincount(ancestor, weight * value[leaf], len(cell)) for value in leaves[2:]]
    up = np.stack(mean[1:], axis=1)
    size = float(cells.domain.cell_size(level))
    x = cells.domain.xmin + (cell % n + 0.5) * size
    y = cells.domain.ymin + (cell // n + 0.5) * size
    z = mean[0] / np.bincount(ancestor, weight, len(cell))
    planes = np.column_stack([x, y, z, up / np.linalg.norm(up, axis=1, keepdims=True)])
    range_part = np.zeros((len(cell), 3, 3))
    fuse_leaves(leaves[:, leaf], cells.covariance_range[leaf], ancestor, planes, range_part)
    # Both are planes, so their distance varies linearly and is greatest at a corner.
    off, own = np.zeros(len(of_leaf)), np.flatnonzero(of_leaf >= 0)
    x, y, z, *normal = leaves[:, own]
    fused_x, fused_y, fused_z, east, north, up = planes.T[:, of_leaf[own]]
    middle = east * (x - fused_x) + north * (y - fused_y) + up * (z - fused_z)
    corner = np.abs(east - up * normal[0] / normal[2]) + np.abs(north - up * normal[1] / normal[2])
    off[own] = np.abs(middle) + 0.5 * cells.size[own] * corner
    return Ancestors(cell, planes, range_part, of_leaf, off)


@cython.boundscheck(False)
@cython.locals(leaves=cython.double[:, :], ranges=cython.double[:, :, ::1])
@cython.locals(ancestor=cython.Py_ssize_t[::1], planes=cython.double[:, ::1])
@cython.locals(range_part=cython.double[:, :, ::1])
def fuse_leaves(
    leaves: Array, ranges: Array, ancestor: Index, planes: Array, range_part: Array
) -> None:
    """Fuse planes (6, M) of covariances (M, 3, 3) into those of their ancestors, rows (M,) of
    ``planes`` (A, 6), which have the place and direction to linearise about. ``range_part``
    (A, 3, 3) is 0 before; ``ranges`` is overwritten."""
    cython.declare(k=cython.Py_ssize_t, a=cython.Py_ssize_t, i=cython.Py_ssize_t)
    cython.declare(j=cython.Py_ssize_t)
    pulled = cython.declare(cython.double[:, ::1], np.zeros((len(planes), 3)))
    own = cython.declare(cython.double[3])
    mean = cython.declare(cython.double[3])
    arm = cython.declare(cython.double[3])
    error = cython.declare(cython.double[3])
    basis = cython.declare(cython.double[6])
    turn = cython.declare(cython.double[4])
    covariance = cython.declare(cython.p_double)
    information = cython.declare(cython.double[9])
    with cython.nogil:
        # Each leaf seen from its ancestor's centre, its error in the tangent at the mean normal.
        for k in range(ancestor.shape[0]):
            a = ancestor[k]
            for i in range(3):
                arm[i] = planes[a, i] - leaves[i, k]
                own[i], mean[i] = leaves[3 + i, k], planes[a, 3 + i]
            covariance = cython.address(ranges[k, 0, 0])
            basis_at(own, basis)
            minus_at(own, mean, error, turn)
            first = basis[0] * arm[0] + basis[1] * arm[1] + basis[2] * arm[2]
            second = basis[3] * arm[0] + basis[4] * arm[1] + basis[5] * arm[2]
            plane.shift_origin(covariance, first, second, 1)
            plane.turn_tangent(covariance, turn, 1)
            error[2] = -(own[0] * arm[0] + own[1] * arm[1] + own[2] * arm[2])
            plane.inverse_symmetric(covariance, information)
            for i in range(3):
                for j in range(3):
                    range_part[a, i, j] += information[3 * i + j]
                    pulled[a, i] += information[3 * i + j] * error[j]
        for a in range(planes.shape[0]):
            covariance = cython.address(range_part[a, 0, 0])
            plane.inverse_symmetric(covariance, information)
            for i in range(3):
                mean[i], error[i] = planes[a, 3 + i], 0.0
                for j in range(3):
                    error[i] += information[3 * i + j] * pulled[a, j]
            basis_at(mean, basis)
            plus_at(mean, basis, error, own)
            plane.orient_up(own)
            # d / n_z is how far the plane passes above the origin; the origin moves up to it.
            rise = error[2] / own[2]
            planes[a, 2] += rise
            plane.shift_origin(information, -rise * own[0], -rise * own[1], 1)
            for i in range(3):
                planes[a, 3 + i] = own[i]
            for i in range(9):
                covariance[i] = information[i]
