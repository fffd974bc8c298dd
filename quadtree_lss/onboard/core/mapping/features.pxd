# SPDX-License-Identifier: Apache-2.0
cimport cython
from quadtree_lss.onboard.core.mapping.measure cimport Rules, Run
from quadtree_lss.onboard.core.tree.leaves cimport Leaf

@cython.final
cdef class Heights:
    cdef Py_ssize_t[::1] near
    cdef double[::1] x, y, z, bell
    cdef double[:, ::1] row
    cdef Py_ssize_t count
    cdef double weight

cdef double bell(double square) noexcept nogil
cdef void bells(Heights heights, double* state) noexcept nogil
cdef double feature_height(double* state) noexcept nogil
cdef double max_gain(Heights heights, double* state) noexcept nogil
cdef double _linearise(Heights heights, double* state, double* mean, double* information, double* system) noexcept nogil
cdef bint _solve(double* system, double damping, double* step) noexcept nogil
cdef double estimate(Heights heights, double* state, double* information, bint known, double half, double finest) noexcept nogil
cdef void first_state(Py_ssize_t raised, double* high, double count, double area, double least, double* out) noexcept nogil
cdef Py_ssize_t insert_high(double* high, Py_ssize_t held, double x, double y, double z) noexcept nogil
cdef void update_feature(Rules rules, Leaf* leaf, Run* run, double* points, double* residual, double* origin, double side, Heights heights) noexcept nogil
