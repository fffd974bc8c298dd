# SPDX-License-Identifier: Apache-2.0
from quadtree_lss.onboard.core.mapping.measure cimport Rules, Run, ScanPose
from quadtree_lss.onboard.core.tree.leaves cimport Leaf

cdef double MIN_RESIDUALS

cdef double normal_tail(double x) noexcept nogil
cdef double mean_distance(double* points, Py_ssize_t count, double* normal, double* through) noexcept nogil
cdef double mahalanobis_factor(double* mean, double cosine, double* sigma, double along, double plane) noexcept nogil
cdef void set_statistic(Rules rules, Leaf* leaf, Run* run, double* points, ScanPose* pose) noexcept nogil
cdef void add_statistic(Rules rules, Leaf* leaf, Run* run) noexcept nogil
cdef bint misfit_divides(Rules rules, Leaf* leaf, Run* run) noexcept nogil
cdef bint shows_rock(Rules rules, Leaf* leaf) noexcept nogil
cdef bint residuals_divide(Rules rules, Leaf* leaf) noexcept nogil
cdef double misfit_square(Leaf* leaf, double variance) noexcept nogil
cdef double raised_distance(Rules rules, Leaf* leaf, double variance) noexcept nogil
cdef double unexplained_distance(Rules rules, Leaf* leaf, double variance) noexcept nogil
cdef bint view_shows_misfit(Rules rules, Leaf* leaf, Run* run, double* points, double* origin, double side) noexcept nogil
cdef void add_residuals(Rules rules, Leaf* leaf, Run* run, double* points, double* residual, double* origin) noexcept nogil
cdef double exceptions(double* residual, Py_ssize_t count, Py_ssize_t every, double tolerance, double deviation) noexcept nogil
