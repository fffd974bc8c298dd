# SPDX-License-Identifier: Apache-2.0
from libc.math cimport fabs, fmax, sqrt
from quadtree_lss.core.geometry.plane cimport inverse_symmetric
from quadtree_lss.core.mapping.measure cimport Rules, Run, pose_variance
from quadtree_lss.core.mapping.features cimport feature_height
from quadtree_lss.core.tree.leaves cimport Leaf, LeafTable

cdef double mean_distance(double[:, ::1] points, Py_ssize_t begin, Py_ssize_t end, double* normal, double* through) noexcept nogil
cdef double mahalanobis_factor(double* normal, double* mean, double cosine, double[:, ::1] sigma, double along, double plane) noexcept nogil
cpdef bint asks(Rules rules, Leaf[::1] leaf, Py_ssize_t row, Run[::1] runs, Py_ssize_t at) noexcept nogil
cpdef bint hides_rock(Rules rules, Leaf[::1] leaf, Py_ssize_t row, double side) noexcept nogil
