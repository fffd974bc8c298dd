# SPDX-License-Identifier: Apache-2.0
from libc.math cimport exp, fabs, sqrt

cdef class Heights:
    cdef double[::1] x, y, z
    cdef Py_ssize_t count
    cdef double weight
    cdef void clear(self, double weight) noexcept nogil
    cdef void add(self, double x, double y, double z) noexcept nogil

cdef double feature_height(double* state) noexcept nogil
cdef double promise(Heights heights, double* state) noexcept nogil
cdef double _linearise(Heights heights, double* state, double* mean, double* information, double* system) noexcept nogil
cdef bint _solve(double* system, double damping, double* step) noexcept nogil
cdef double estimate(Heights heights, double* state, double* information, bint known, double half, double finest) noexcept nogil
