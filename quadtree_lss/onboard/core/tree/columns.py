# SPDX-License-Identifier: Apache-2.0
"""Leaves as columns, one array for each thing that is published of them."""

from __future__ import annotations

import cython

from quadtree_lss.onboard.arrays import Array, Bytes, Index, Numbers
from quadtree_lss.onboard.core.geometry import feature

if cython.compiled:
    from cython.cimports.libc.math import NAN
    from cython.cimports.quadtree_lss.onboard.core.tree.leaves import INHERITED, MEASURED, LeafTable
else:
    from math import nan as NAN

    from quadtree_lss.onboard.core.tree.leaves import INHERITED, MEASURED, LeafTable

#: A bell fitted to a hemisphere (Eq. 53) by least squares peaks a quarter above it. Its volume is
#: right; a sigma wider by this lowers the peak and keeps it.
WIDER = cython.declare(cython.double, feature.SHAPE**0.5)


@cython.boundscheck(False)
@cython.locals(table=LeafTable, rows=cython.Py_ssize_t[::1], level=cython.uchar[::1])
@cython.locals(measured=cython.uchar[::1], single=cython.double[:, ::1])
@cython.locals(normal=cython.double[:, ::1], range_part=cython.double[:, ::1])
@cython.locals(pose_part=cython.double[:, ::1], bell=cython.double[:, ::1])
def fill_columns(
    table: LeafTable,
    rows: Index,
    whole: tuple[Numbers, Numbers, Numbers],
    level: Bytes,
    measured: Bytes,
    single: Array,
    normal: Array,
    range_part: Array,
    pose_part: Array,
    bell: Array,
) -> None:
    """Fill the columns of ``cell_map.CellMap`` for leaves (M,), NaN where a leaf has none of it.

    ``whole`` are ix, iy and the number of measurements; ``single`` (5, M) the plane's elevation,
    roughness, exception fraction, lowest and highest return; normals (M, 3), covariances (M, 9), of
    which the range part is added to what is there; bells (M, 5).
    """
    cython.declare(i=cython.Py_ssize_t, j=cython.Py_ssize_t)
    ix = cython.declare(cython.uint[::1], whole[0])
    iy = cython.declare(cython.uint[::1], whole[1])
    count = cython.declare(cython.uint[::1], whole[2])
    own: cython.bint
    with cython.nogil:
        for i in range(rows.shape[0]):
            leaf = table.at(rows[i])
            own = leaf.known == MEASURED
            # Adding a number that is none makes none of what is not known.
            unknown = 0.0 if leaf.known >= INHERITED else NAN
            unmeasured = 0.0 if own else NAN
            level[i], ix[i], iy[i], measured[i] = leaf.level, leaf.ix, leaf.iy, own
            count[i] = cython.cast(cython.uint, leaf.points) if own else 0
            counted = max(leaf.residuals, 1.0)
            # On flat ground noise is all there is, and times a large cell's area it would look
            # rough.
            mean = max(leaf.distance_sum - leaf.noise_sum, 0.0) / counted
            side = table.side(leaf.level)
            single[0, i] = leaf.z + unknown
            single[1, i] = side * side * mean + unmeasured
            single[2, i] = leaf.exception_sum / counted + unmeasured
            single[3, i] = leaf.low if leaf.low <= leaf.high else NAN
            single[4, i] = leaf.high if leaf.low <= leaf.high else NAN
            for j in range(3):
                normal[i, j] = leaf.normal[j] + unknown
            for j in range(9):
                range_part[i, j] += leaf.range_part[j] + unknown
                pose_part[i, j] = leaf.pose_part[j] + unknown
            for j in range(5):
                bell[i, j] = leaf.feature[j]
            bell[i, 4] *= WIDER
