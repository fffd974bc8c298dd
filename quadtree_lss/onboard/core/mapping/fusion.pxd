# SPDX-License-Identifier: Apache-2.0
cimport cython
from quadtree_lss.onboard.core.mapping.measure cimport Rules, Run
from quadtree_lss.onboard.core.tree.leaves cimport Leaf

@cython.final
cdef class Fusion:
    cdef Rules rules
    cdef bint aligned
    cdef double now, common_at, common_is
    cdef double origin[3]
    cdef double sigma[36]
    cpdef align(self, double down)
    cdef bint contradicts(self, Leaf* leaf, Run* run) noexcept nogil
    cdef void place(self, Leaf* leaf, Run* run, double* out) noexcept nogil
    cdef void doubt(self, Leaf* leaf, Run* run) noexcept nogil
    cdef void fuse(self, Leaf* leaf, Run* run, bint same_scan) noexcept nogil
    cdef void _along(self, Leaf* leaf, Run* run, double* out) noexcept nogil
    cdef double _height(self, double* known) noexcept nogil
    cdef void _turn(self, Leaf* leaf, Run* run) noexcept nogil
    cdef bint _apart(self, Leaf* leaf, Run* run) noexcept nogil
    cdef double common(self, double time) noexcept nogil
