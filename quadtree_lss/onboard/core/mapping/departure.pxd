# SPDX-License-Identifier: Apache-2.0
from libc.math cimport exp, fabs, sqrt
from quadtree_lss.onboard.core.geometry.plane cimport inverse_symmetric

cpdef departure(double[:, :] cells, double[:, ::1] sigma, double now, double correlation_time, double limit, double metre=*)
cdef void _motion(double[:, :] cells, Py_ssize_t i, double* out) noexcept nogil
