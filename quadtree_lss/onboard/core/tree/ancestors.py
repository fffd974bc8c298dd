# SPDX-License-Identifier: Apache-2.0
"""Planes of the cells of a higher level, fused from the leaves' (paper IV.C)."""

from __future__ import annotations

from dataclasses import dataclass

import cython
import numpy as np
from cython.cimports.libc.math import fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry import plane
from cython.cimports.quadtree_lss.onboard.core.geometry.sphere import basis_at, minus_at, plus_at

from quadtree_lss.onboard.arrays import Array, Index
from quadtree_lss.onboard.core.tree.cell_map import CellMap


@dataclass(frozen=True)
class Ancestors:
    """Fused planes of the cells of one level that have a measured leaf below them.

    Attributes:
        cell: (A,) iy * 2^level + ix.
        x, y, z: (A,) plane's elevation z above the cell's centre, m.
        normal: (A, 3).
        range_part: (A, 3, 3) covariance of (dphi_1, dphi_2, dd), d about (x, y, z), from range
            noise.
        of_leaf: (M,) place of each leaf's ancestor, -1 where there is none (the leaf is of a
            higher level, or nothing below the ancestor was measured).
        off: (M,) greatest distance of each leaf's plane from its ancestor's, along the normal of
            that, over the leaf's square, m; 0 where there is none.
    """

    cell: Index
    x: Array
    y: Array
    z: Array
    normal: Array
    range_part: Array
    of_leaf: Index
    off: Array


def fuse_to_level(cells: CellMap, level: int) -> Ancestors:
    """Fuse leaves to their ancestors of ``level`` by Eq. 39-45.

    Each leaf's plane is moved to the ancestor's centre (exactly, value and covariance) and
    observes it. Range noise is independent between leaves, so the range parts weigh and average:
    E = (sum R_i^-1)^-1 sum R_i^-1 E_i. Pose error is shared and decides nothing between them.
    Inherited planes are no information.

    Fusing children of children at once is the same as level by level, information being additive.
    """
    n = 1 << level
    of_leaf, place = np.empty(len(cells.level), dtype=np.intp), np.full(n * n, -1, dtype=np.intp)
    find_ancestors(cells, level, place, of_leaf)
    cell = np.flatnonzero(place >= 0)
    size = float(cells.domain.cell_size(level))
    planes, off = np.zeros((len(cell), 6)), np.zeros(len(of_leaf))
    range_part = np.zeros((len(cell), 3, 3))
    planes[:, 0] = cells.domain.xmin + (cell % n + 0.5) * size
    planes[:, 1] = cells.domain.ymin + (cell // n + 0.5) * size
    fuse_leaves(cells, of_leaf, planes, range_part, off)
    x, y, z = planes[:, :3].T
    return Ancestors(cell, x, y, z, planes[:, 3:], range_part, of_leaf, off)


@cython.boundscheck(False)
@cython.locals(at=cython.int, place=cython.Py_ssize_t[::1], of_leaf=cython.Py_ssize_t[::1])
def find_ancestors(cells: CellMap, at: int, place: Index, of_leaf: Index) -> None:
    """Number the cells of the level ``at`` that have a measured leaf below them: ``place`` (4^at,)
    is -1, which stays where there is none; ``of_leaf`` (M,) is set to that of each leaf's, -1 of
    those of a higher level."""
    cython.declare(k=cython.Py_ssize_t, a=cython.Py_ssize_t, found=cython.Py_ssize_t)
    level = cython.declare(cython.uchar[::1], cells.level)
    ix = cython.declare(cython.uint[::1], cells.ix)
    iy = cython.declare(cython.uint[::1], cells.iy)
    measured = cython.declare(cython.uchar[::1], cells.measured.view(np.uint8))
    down: cython.int
    found = 0
    with cython.nogil:
        for k in range(level.shape[0]):
            down = cython.cast(cython.int, level[k]) - at
            of_leaf[k] = -1 if down < 0 else ((iy[k] >> down) << at) + (ix[k] >> down)
            if down >= 0 and measured[k]:
                place[of_leaf[k]] = 0
        for a in range(place.shape[0]):
            if place[a] == 0:
                place[a] = found
                found += 1
        for k in range(level.shape[0]):
            if of_leaf[k] >= 0:
                of_leaf[k] = place[of_leaf[k]]


@cython.boundscheck(False)
@cython.locals(ancestor=cython.Py_ssize_t[::1], planes=cython.double[:, ::1])
@cython.locals(range_part=cython.double[:, :, ::1], off=cython.double[::1])
def fuse_leaves(
    cells: CellMap, ancestor: Index, planes: Array, range_part: Array, off: Array
) -> None:
    """Fuse the measured leaves (M) into their ancestors (A).

    Args:
        cells: The map.
        ancestor: (M,) of each leaf, 0 .. A - 1, or less where it has none.
        planes: (A, 6) x and y of the ancestors' centres, m; what is 0 is set: z and the normal.
        range_part: (A, 3, 3) their covariances; 0 before.
        off: (M,) as of `Ancestors`; 0 before.
    """
    measured = cython.declare(cython.uchar[::1], cells.measured.view(np.uint8))
    size = cython.declare(cython.double[::1], cells.size)
    x = cython.declare(cython.double[::1], cells.x)
    y = cython.declare(cython.double[::1], cells.y)
    z = cython.declare(cython.double[::1], cells.z)
    normal = cython.declare(cython.double[:, ::1], cells.normal)
    count = cython.declare(cython.uint[::1], cells.count)
    of_leaves = cython.declare(cython.double[:, :, ::1], cells.covariance_range)
    cython.declare(k=cython.Py_ssize_t, a=cython.Py_ssize_t, i=cython.Py_ssize_t)
    cython.declare(j=cython.Py_ssize_t)
    number: cython.Py_ssize_t = planes.shape[0]
    total = cython.declare(cython.double[::1], np.zeros(number))
    pulled = cython.declare(cython.double[:, ::1], np.zeros((number, 3)))
    own = cython.declare(cython.double[3])
    mean = cython.declare(cython.double[3])
    arm = cython.declare(cython.double[3])
    error = cython.declare(cython.double[3])
    basis = cython.declare(cython.double[6])
    turn = cython.declare(cython.double[4])
    ranges = cython.declare(cython.double[9])
    information = cython.declare(cython.double[9])
    with cython.nogil:
        for k in range(ancestor.shape[0]):
            a = ancestor[k]
            if a < 0 or not measured[k]:
                continue
            weight = max(count[k], 1.0)
            total[a] += weight
            planes[a, 2] += weight * z[k]
            for i in range(3):
                planes[a, 3 + i] += weight * normal[k, i]
        for a in range(number):
            planes[a, 2] /= total[a]
            east, north, up = planes[a, 3], planes[a, 4], planes[a, 5]
            length = sqrt(east * east + north * north + up * up)
            for i in range(3, 6):
                planes[a, i] /= length
        # Each leaf seen from its ancestor's centre, its error in the tangent at the mean normal.
        for k in range(ancestor.shape[0]):
            a = ancestor[k]
            if a < 0 or not measured[k]:
                continue
            arm[0], arm[1], arm[2] = planes[a, 0] - x[k], planes[a, 1] - y[k], planes[a, 2] - z[k]
            for i in range(3):
                own[i], mean[i] = normal[k, i], planes[a, 3 + i]
                for j in range(3):
                    ranges[3 * i + j] = of_leaves[k, i, j]
            basis_at(own, basis)
            minus_at(own, mean, error, turn)
            first = basis[0] * arm[0] + basis[1] * arm[1] + basis[2] * arm[2]
            second = basis[3] * arm[0] + basis[4] * arm[1] + basis[5] * arm[2]
            plane.shift_origin(ranges, first, second, 1)
            plane.turn_tangent(ranges, turn, 1)
            error[2] = -(own[0] * arm[0] + own[1] * arm[1] + own[2] * arm[2])
            plane.inverse_symmetric(ranges, information)
            for i in range(3):
                for j in range(3):
                    range_part[a, i, j] += information[3 * i + j]
                    pulled[a, i] += information[3 * i + j] * error[j]
        for a in range(number):
            for i in range(3):
                for j in range(3):
                    information[3 * i + j] = range_part[a, i, j]
            plane.inverse_symmetric(information, ranges)
            for i in range(3):
                mean[i], error[i] = planes[a, 3 + i], 0.0
                for j in range(3):
                    error[i] += ranges[3 * i + j] * pulled[a, j]
            basis_at(mean, basis)
            plus_at(mean, basis, error, own)
            plane.orient_up(own)
            # d / n_z is how far the plane passes above the origin; the origin moves up to it.
            rise = error[2] / own[2]
            planes[a, 2] += rise
            plane.shift_origin(ranges, -rise * own[0], -rise * own[1], 1)
            for i in range(3):
                planes[a, 3 + i] = own[i]
                for j in range(3):
                    range_part[a, i, j] = ranges[3 * i + j]
        # Both are planes, so their distance varies linearly and is greatest at a corner.
        for k in range(ancestor.shape[0]):
            a = ancestor[k]
            if a < 0:
                continue
            east, north, up = planes[a, 3], planes[a, 4], planes[a, 5]
            middle = east * (x[k] - planes[a, 0]) + north * (y[k] - planes[a, 1])
            middle += up * (z[k] - planes[a, 2])
            corner = fabs(east - up * normal[k, 0] / normal[k, 2])
            corner += fabs(north - up * normal[k, 1] / normal[k, 2])
            off[k] = fabs(middle) + 0.5 * size[k] * corner
