# SPDX-License-Identifier: Apache-2.0
from libc.math cimport fabs, sqrt
from quadtree_lss.onboard.core.geometry.sphere cimport basis_at
from quadtree_lss.onboard.core.mapping.division cimport mahalanobis_factor
from quadtree_lss.onboard.core.mapping.measure cimport pose_variance, range_variance

cpdef residuals(double[:, ::1] points, Py_ssize_t[::1] leaf, double[:, ::1] centre, double[:, ::1] normal, double[:, ::1] covariance, double[:, ::1] sigma, double range_noise, double per_metre, double divergence, double[:, ::1] out)
