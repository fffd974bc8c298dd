# SPDX-License-Identifier: Apache-2.0
from libc.math cimport fabs, sqrt
from quadtree_lss.onboard.core.mapping.measure cimport Rules, Run, few, partial
from quadtree_lss.onboard.core.geometry.portable cimport above
from quadtree_lss.onboard.core.tree.leaves cimport Leaf

cdef double raised_from(Rules rules, Leaf* leaf, double variance) noexcept nogil
cdef double standing_out(Rules rules, Leaf* leaf, double variance) noexcept nogil
cdef bint departs(Rules rules, Leaf* leaf, Run* run, double[:, ::1] points, Py_ssize_t begin, Py_ssize_t end, double* origin, double side) noexcept nogil
cdef void rest(Rules rules, Leaf* leaf, Run* run, double[:, ::1] points, double[::1] residual, Py_ssize_t begin, Py_ssize_t end, double* origin) noexcept nogil
cdef double exceptions(double[::1] residual, Py_ssize_t begin, Py_ssize_t end, Py_ssize_t every, double tolerance, double deviation) noexcept nogil
