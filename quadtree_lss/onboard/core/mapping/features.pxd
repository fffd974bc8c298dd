# SPDX-License-Identifier: Apache-2.0
from libc.math cimport NAN, exp, fabs, isfinite, sqrt
from quadtree_lss.onboard.core.mapping.bell cimport Heights, estimate, feature_height, promise
from quadtree_lss.onboard.core.mapping.measure cimport Rules
from quadtree_lss.onboard.core.tree.leaves cimport Leaf

cdef void first_state(Py_ssize_t raised, double* high, double count, double area, double* out) noexcept nogil
cdef Py_ssize_t insert_high(double* high, Py_ssize_t held, double x, double y, double z) noexcept nogil
cdef void update_feature(Rules rules, Leaf* leaf, double[:, ::1] points, double[::1] residual, Py_ssize_t begin, Py_ssize_t end, double x, double y, double side, double variance, double greatest, Heights heights) noexcept nogil
