# SPDX-License-Identifier: Apache-2.0
from libc.math cimport fabs

cpdef farthest_corner(
    Py_ssize_t[::1] above,
    double[:, ::1] leaves,
    double[:, ::1] normal,
    double[:, ::1] planes,
    double[:, ::1] fused,
    double[::1] out,
)
