# SPDX-License-Identifier: Apache-2.0
from libc.math cimport exp, fabs, sqrt

cpdef double above(double deviations) noexcept nogil
cdef double length(double x, double y) noexcept nogil
cpdef void multiply(const double[:, :] a, const double[:, :] b, double[:, ::1] out) noexcept
cdef void scale_columns(double[:, ::1] v, double[:, ::1] a, double most) noexcept
cpdef void diagonalise(double[:, ::1] a, double[:, ::1] v) noexcept
