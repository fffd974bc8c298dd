# SPDX-License-Identifier: Apache-2.0
# cython: boundscheck=False
"""Columns of `cell_map.CellMap` from the table of leaves, and whether received ones can be."""

from __future__ import annotations

from typing import Any

import cython
import numpy as np
from cython.cimports.libc.math import NAN, fabs, sqrt
from cython.cimports.quadtree_lss.onboard.core.geometry.morton import encode
from cython.cimports.quadtree_lss.onboard.core.tree import leaves
from cython.cimports.quadtree_lss.onboard.core.tree.leaves import LeafTable

from quadtree_lss.onboard.arrays import Array, Index, Mask
from quadtree_lss.onboard.core.geometry import bounds
from quadtree_lss.onboard.core.tree.cell_map import SHAPE

#: A bell fitted to a hemisphere (Eq. 53) by least squares peaks a quarter above it. Its volume is
#: right; a sigma wider by this lowers the peak and keeps it.
WIDER = cython.declare(cython.double, SHAPE**0.5)
#: The least sigma of a feature, m, and the least n_z of a normal (`geometry.plane.orient_up`).
LEAST_SIGMA = cython.declare(cython.double, 1e-6)
LEAST_UP = cython.declare(cython.double, 1e-3)
MAX_VALUE = cython.declare(cython.double, bounds.MAX_VALUE)
MAX_HEIGHT = cython.declare(cython.double, bounds.MAX_HEIGHT)
#: Greatest correlation, with round-off.
MAX_CORRELATION = cython.declare(cython.double, 1.1)


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
            own = leaf.state == leaves.ESTIMATED
            # Adding NaN marks missing values without a branch.
            unknown = 0.0 if leaf.state >= leaves.INHERITED else NAN
            unmeasured = 0.0 if own else NAN
            mark[0, i], mark[1, i], number[0, i], number[1, i] = leaf.level, own, leaf.ix, leaf.iy
            number[2, i] = cython.cast(cython.uint, leaf.points) if own else 0
            counted = max(leaf.residuals, 1.0)
            # Without the noise floor, which a large cell's area would turn into roughness.
            mean = max(leaf.distance_sum - leaf.noise_sum, 0.0) / counted
            excepted = max(leaf.exception_sum - leaf.exception_noise, 0.0) / counted
            side = table.sides[leaf.level]
            column[0, i] = leaf.z + unknown
            column[1, i] = side * side * mean + unmeasured
            column[2, i] = excepted + unmeasured
            column[3, i] = leaf.low if leaf.low <= leaf.high else NAN
            column[4, i] = leaf.high if leaf.low <= leaf.high else NAN
            down = 2 * (table.max_level - leaf.level)
            code = encode(leaf.ix, leaf.iy) << down
            mapped = covered = 0.0
            for j in range(code, code + (1 << down)):
                if table.seen[j] > leaves.OBSERVED:
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


@cython.locals(z=cython.double[:], normal=cython.double[:, :], feature=cython.double[:, :])
@cython.locals(range_part=cython.double[:, :, :], pose_part=cython.double[:, :, :])
def sound_planes(
    z: Array, normal: Array, range_part: Array, pose_part: Array, feature: Array
) -> Mask:
    """Return (M,) whether planes and features from a file or message are possible.

    ``z`` (M,), m; ``normal`` (M, 3); ``range_part``, ``pose_part`` (M, 3, 3) of the covariance;
    ``feature`` (M, 5).
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.int, k=cython.int, present=cython.int)
    sigma = cython.declare(cython.double[3])
    found = np.empty(len(z), dtype=np.bool_)
    sound = cython.declare(cython.uchar[::1], found.view(np.uint8))
    ok: cython.bint
    for i in range(z.shape[0]):
        square = normal[i, 0] * normal[i, 0] + normal[i, 1] * normal[i, 1]
        square += normal[i, 2] * normal[i, 2]
        ok = fabs(square - 1.0) < 1e-6 and normal[i, 2] >= LEAST_UP and fabs(z[i]) < MAX_HEIGHT
        for j in range(3):
            ok = ok and range_part[i, j, j] >= 0.0 and pose_part[i, j, j] >= 0.0
            sigma[j] = sqrt(fabs(range_part[i, j, j] + pose_part[i, j, j]))
        for j in range(3):
            for k in range(3):
                limit = min(MAX_CORRELATION * sigma[j] * sigma[k], MAX_VALUE)
                ok = ok and fabs(range_part[i, j, k]) <= limit
                ok = ok and fabs(pose_part[i, j, k]) <= limit
        present = 0
        for j in range(5):
            present += feature[i, j] == feature[i, j]
            ok = ok and not fabs(feature[i, j]) >= MAX_HEIGHT
        sound[i] = ok and (present == 0 or present == 5 and feature[i, 4] >= LEAST_SIGMA)
    return found
