# SPDX-License-Identifier: Apache-2.0
from quadtree_lss.onboard.core.tree.leaves cimport Leaf, LeafTable

cdef struct Run:
    double points
    double centroid[3]
    double scatter[6]
    double normal[3]
    double z
    double cosine
    double variance
    double square
    double statistic
    double unobserved
    double has_slope
    double height_only
    double mean_variance
    double raised_limit
    double offset_limit
    double max_residual
    double common_share
    double lever[2]
    double range_part[9]
    double pose_part[9]
    double bias[5]

#: Pose of a scan's lidar, map frame: position, m, its covariance, and boresight (unit vector).
cdef struct ScanPose:
    double origin[3]
    double sigma[36]
    double boresight[3]

cdef double FIT_POINTS

cdef class Rules:
    cdef readonly double range_noise, stereo
    cdef readonly bint ml, independent, mahalanobis
    cdef readonly double division_factor, divide_exceptions, rock_area, mound_height
    cdef readonly double correlation_time
    cdef readonly double uneven, slack, clip, tolerance
    cdef readonly double feature_height, feature_volume, feature_width
    cdef readonly double rock_height, rock_sigma

cdef bint is_partial(Run* run) noexcept nogil
cdef bint has_few_points(Run* run) noexcept nogil
cdef double pose_variance(double* normal, double* arm, double* sigma) noexcept nogil
cdef double range_noise(Rules rules, double* centroid, double distance, double* boresight) noexcept nogil
cdef double _unobserved_width(double square, double correlation, double side) noexcept nogil
cdef void _bias(Run* run, double ray_x, double ray_y, double deviation, double lean, bint sloped) noexcept nogil
cdef void measure(Rules rules, Leaf* leaf, Run* run, double* points, Py_ssize_t number, ScanPose* pose, double side) noexcept nogil
cpdef unobserved_parts(LeafTable table, Py_ssize_t[::1] rows, double[:, ::1] out)
