# SPDX-License-Identifier: Apache-2.0
cimport cython
from quadtree_lss.onboard.core.mapping.measure cimport Rules, Run, ScanPose
from quadtree_lss.onboard.core.tree.leaves cimport Leaf

@cython.final
cdef class Fusion:
    cdef Rules rules
    cdef bint aligned
    cdef double now, correlation_at, correlation_is
    cdef ScanPose pose
    cdef bint is_elsewhere(self, Leaf* leaf, Run* run) noexcept nogil
    cdef void offset_at(self, Leaf* leaf, Run* run, double* out) noexcept nogil
    cdef void limit_offset(self, Leaf* leaf, Run* run) noexcept nogil
    cdef void fuse(self, Leaf* leaf, Run* run, bint same_scan) noexcept nogil
    cdef void _ray_in_plane(self, Leaf* leaf, Run* run, double* out) noexcept nogil
    cdef double _height_variance(self, double* known) noexcept nogil
    cdef void _set_line_bias(self, Leaf* leaf, Run* run) noexcept nogil
    cdef bint _is_spread(self, Leaf* leaf, Run* run) noexcept nogil
    cdef double correlation(self, double time) noexcept nogil
