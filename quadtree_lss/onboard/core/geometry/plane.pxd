# SPDX-License-Identifier: Apache-2.0

cdef struct PlaneParts:
    double* normal
    double* range_part
    double* pose_part

cdef void interleave(double* c, double* d, double* out) noexcept nogil
cdef void congruent(double* a, double* pair, double* out) noexcept nogil
cdef void inverse_symmetric(double* c, double* out) noexcept nogil
cdef void turn_tangent(double* c, double* change, int count) noexcept nogil
cdef double offset_variance(double* c, double first, double second) noexcept nogil
cdef void uncorrelate(double* c, int i, double variance) noexcept nogil
cdef void shift_origin(double* c, double first, double second, int count) noexcept nogil
cdef void moments(double* points, Py_ssize_t count, double* mean, double* scatter) noexcept nogil
cdef void height_normal(double* scatter, double slope_x, double slope_y, double spread, double* normal) noexcept nogil
cdef void orthogonal_normal(double* scatter, double* normal) noexcept nogil
cdef void line_normal(double* scatter, double* prior, double along, double spread, double* normal, double* line) noexcept nogil
cdef void orient_up(double* normal) noexcept nogil
cdef void slope_covariance(double* scatter, double* normal, double variance, double* out) noexcept nogil
cdef void covariance_about(double* slope, double offset_variance, double first, double second, double* out) noexcept nogil
cdef void pose_part(double* normal, double* basis, double* arm, double* sigma, double* out) noexcept nogil
cdef double fuse(PlaneParts* plane, double rise, PlaneParts* other, double common) noexcept nogil
cdef double fuse_height(PlaneParts* plane, double rise, double* lever, double variance, double* other_pose, double common, bint sloped) noexcept nogil
cdef void _pivot(double* c, double rise, double* basis, double* arm, double* out) noexcept nogil
cdef double _from_pivot(double* pair, double* pivot, double* step, double* basis, PlaneParts* out) noexcept nogil
cdef double _quadratic(double* scatter, double* a, double* b) noexcept nogil
