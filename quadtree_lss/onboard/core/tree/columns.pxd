# SPDX-License-Identifier: Apache-2.0
from libc.math cimport NAN
from quadtree_lss.onboard.core.tree.leaves cimport INHERITED, MEASURED, LeafTable

cpdef fill_columns(
    LeafTable table,
    Py_ssize_t[::1] rows,
    tuple whole,
    unsigned char[::1] level,
    unsigned char[::1] measured,
    double[:, ::1] single,
    double[:, ::1] normal,
    double[:, ::1] range_part,
    double[:, ::1] pose_part,
    double[:, ::1] bell,
)
