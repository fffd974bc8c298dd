# SPDX-License-Identifier: Apache-2.0
from quadtree_lss.onboard.core.mapping.measure cimport Rules, Run
from quadtree_lss.onboard.core.tree.leaves cimport Leaf

cdef double normal_tail(double x) noexcept nogil
cdef double mean_distance(double* points, Py_ssize_t count, double* normal, double* through) noexcept nogil
cdef double mahalanobis_factor(double* mean, double cosine, double* sigma, double along, double plane) noexcept nogil
cdef void judge(Rules rules, Leaf* leaf, Run* run, double* points, double* origin, double* sigma) noexcept nogil
cdef bint asks(Rules rules, Leaf* leaf, Run* run) noexcept nogil
cdef bint hides_rock(Rules rules, Leaf* leaf) noexcept nogil
cdef bint rough(Rules rules, Leaf* leaf) noexcept nogil
cdef double left_out(Leaf* leaf, double variance) noexcept nogil
cdef double raised_from(Rules rules, Leaf* leaf, double variance) noexcept nogil
cdef double standing_out(Rules rules, Leaf* leaf, double variance) noexcept nogil
cdef bint departs(Rules rules, Leaf* leaf, Run* run, double* points, double* origin, double side) noexcept nogil
cdef void rest(Rules rules, Leaf* leaf, Run* run, double* points, double* residual, double* origin) noexcept nogil
cdef double exceptions(double* residual, Py_ssize_t count, Py_ssize_t every, double tolerance, double deviation) noexcept nogil
