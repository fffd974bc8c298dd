# SPDX-License-Identifier: Apache-2.0
"""Columns of `cell_map.CellMap` from the table of leaves."""

from __future__ import annotations

from typing import Any

import cython
import numpy as np
from cython.cimports.libc.math import NAN
from cython.cimports.quadtree_lss.onboard.core.geometry.morton import encode
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import (
    ESTIMATED,
    INHERITED,
    OBSERVED,
    LeafTable,
)

from quadtree_lss.onboard.arrays import Array, Index, Single
from quadtree_lss.onboard.core.tree.cell_map import SHAPE, CellMap

#: A bell fitted to a hemisphere (Eq. 53) by least squares peaks a quarter above it. Its volume is
#: right; a sigma wider by this lowers the peak and keeps it.
WIDER = cython.declare(cython.double, SHAPE**0.5)


@cython.boundscheck(False)
@cython.locals(table=LeafTable, rows=cython.Py_ssize_t[::1], range_part=cython.double[:, ::1])
def leaf_columns(table: LeafTable, rows: Index, range_part: Array) -> dict[str, Any]:
    """Return the columns of ``cell_map.CellMap``, by name, of leaves (M,), NaN where a leaf has no
    value. ``range_part`` (M, 9): extra covariance, to which that of the leaves is added in place.
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t, m=cython.Py_ssize_t)
    m = rows.shape[0]
    whole, bits, single = np.empty((3, m), np.uint32), np.empty((2, m), np.uint8), np.empty((6, m))
    vectors, covariance, features = np.empty((m, 3)), np.empty((m, 9)), np.empty((m, 5))
    number = cython.declare(cython.uint[:, ::1], whole)
    mark = cython.declare(cython.uchar[:, ::1], bits)
    column = cython.declare(cython.double[:, ::1], single)
    normal = cython.declare(cython.double[:, ::1], vectors)
    pose_part = cython.declare(cython.double[:, ::1], covariance)
    bell = cython.declare(cython.double[:, ::1], features)
    own: cython.bint
    code = cython.declare(cython.Py_ssize_t)
    hits = cython.declare(cython.uint)
    down = cython.declare(cython.int)
    with cython.nogil:
        for i in range(rows.shape[0]):
            table.prefetch_leaf(rows[min(i + 4, m - 1)])
            leaf = table.at(rows[i])
            own = leaf.state == ESTIMATED
            # Adding NaN marks missing values without a branch.
            unknown = 0.0 if leaf.state >= INHERITED else NAN
            unmeasured = 0.0 if own else NAN
            mark[0, i], mark[1, i], number[0, i], number[1, i] = leaf.level, own, leaf.ix, leaf.iy
            number[2, i] = cython.cast(cython.uint, leaf.points) if own else 0
            counted = max(leaf.residuals, 1.0)
            # Without the noise floor, which a large cell's area would turn into roughness.
            mean = max(leaf.distance_sum - leaf.noise_sum, 0.0) / counted
            excepted = max(leaf.exception_sum - leaf.exception_noise, 0.0) / counted
            side = table.side(leaf.level)
            column[0, i] = leaf.z + unknown
            column[1, i] = side * side * mean + unmeasured
            column[2, i] = excepted + unmeasured
            column[3, i] = leaf.low if leaf.low <= leaf.high else NAN
            column[4, i] = leaf.high if leaf.low <= leaf.high else NAN
            down = 2 * (table.max_level - leaf.level)
            code = encode(leaf.ix, leaf.iy) << down
            mapped = covered = 0.0
            for j in range(code, code + (1 << down)):
                if table.seen[j] > OBSERVED:
                    mapped += 1.0
                    hits = table.hits[j]
                    while hits:
                        hits &= hits - 1
                        covered += 1.0
            column[5, i] = covered / (16.0 * max(mapped, 1.0))
            for j in range(3):
                normal[i, j] = leaf.normal[j] + unknown
            for j in range(9):
                range_part[i, j] += leaf.range_part[j] + unknown
                pose_part[i, j] = leaf.pose_part[j] + unknown
            for j in range(5):
                bell[i, j] = leaf.feature[j]
            bell[i, 4] *= WIDER
    names = ("z", "roughness", "exception_fraction", "low", "high", "coverage")
    return {
        "level": bits[0],
        "measured": bits[1].view(np.bool_),
        **dict(zip(("ix", "iy", "count"), whole, strict=True)),
        **dict(zip(names, single, strict=True)),
        "normal": vectors,
        "covariance_range": np.asarray(range_part).reshape(-1, 3, 3),
        "covariance_pose": covariance.reshape(-1, 3, 3),
        "feature": features,
    }


@cython.boundscheck(False)
@cython.locals(plane=cython.double[:, :], rest=cython.float[:, :])
def pack(cells: CellMap, plane: Array, rest: Single) -> None:
    """Columns of a map (M, ...) side by side: sizes, elevations and normals as ``plane`` (M, 5);
    covariances (upper triangles), roughness, exceptions and features as ``rest`` (M, 19)."""
    cython.declare(i=cython.Py_ssize_t, j=cython.int, k=cython.int, at=cython.int)
    size = cython.declare(cython.double[:], cells.size)
    z = cython.declare(cython.double[:], cells.z)
    normal = cython.declare(cython.double[:, :], cells.normal)
    range_part = cython.declare(cython.double[:, :, :], cells.covariance_range)
    pose_part = cython.declare(cython.double[:, :, :], cells.covariance_pose)
    roughness = cython.declare(cython.double[:], cells.roughness)
    exception = cython.declare(cython.double[:], cells.exception_fraction)
    bell = cython.declare(cython.double[:, :], cells.feature)
    with cython.nogil:
        for i in range(plane.shape[0]):
            plane[i, 0], plane[i, 1] = size[i], z[i]
            at = 0
            for j in range(3):
                plane[i, 2 + j] = normal[i, j]
                for k in range(j, 3):
                    rest[i, at] = range_part[i, j, k]
                    rest[i, 6 + at] = pose_part[i, j, k]
                    at += 1
            rest[i, 12], rest[i, 13] = roughness[i], exception[i]
            for j in range(5):
                rest[i, 14 + j] = bell[i, j]
