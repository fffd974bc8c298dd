# SPDX-License-Identifier: Apache-2.0
cimport cython
from quadtree_lss.onboard.core.mapping.features cimport Heights
from quadtree_lss.onboard.core.mapping.fusion cimport Fusion
from quadtree_lss.onboard.core.mapping.measure cimport Rules, Run
from quadtree_lss.onboard.core.tree.leaves cimport Leaf, LeafTable

cpdef enum:  # rows of `ScanUpdate.fit`
    RISE, NOISE_VARIANCE, SCAN_VARIANCE, MAP_VARIANCE, FIRST_TIME, LAST_TIME,
    PLACE_X, PLACE_Y, PLACE_Z, SLOPE_X, SLOPE_Y, SLOPE_VARIANCE, ROWS

cdef void set_states(unsigned char[::1] seen, long long[::1] key, Py_ssize_t begin, Py_ssize_t end, unsigned char state) noexcept nogil

cdef class ScanBuffers:
    cdef Py_ssize_t points, cells
    cdef Py_ssize_t[::1] begins, rows
    cdef double[::1] residual
    cdef double[:, ::1] ratio
    cdef Heights heights
    cdef Run[::1] runs
    cpdef reserve_points(self, Py_ssize_t points)
    cpdef reserve_runs(self, Py_ssize_t cells)

@cython.final
cdef class ScanUpdate:
    cdef LeafTable table
    cdef Rules rules
    cdef ScanBuffers buffers
    cdef Fusion fusion
    cdef double[:, ::1] points
    cdef double[::1] residual
    cdef long long[::1] key
    cdef double[:, ::1] columns
    cdef Run[::1] runs
    cdef Py_ssize_t[::1] rows
    cdef Py_ssize_t[::1] begins
    cdef bint is_new
    cdef readonly Py_ssize_t cells
    cdef Py_ssize_t noise_count
    cdef readonly Py_ssize_t divisions
    cdef readonly bint is_comparable
    cdef readonly Py_ssize_t refused
    cdef void _assume_level(self, Leaf* leaf) noexcept nogil
    cdef void _measure(self, Leaf* leaf, Py_ssize_t begin, Py_ssize_t end, Run* run) noexcept nogil
    cdef bint _comparable(self, Leaf* leaf) noexcept nogil
    cdef void _write_comparison(self, Leaf* leaf, Run* run, Py_ssize_t at) noexcept nogil
    cdef bint _divide(self, Py_ssize_t row, Run* run) noexcept nogil
    cdef void _update_leaf(self, Py_ssize_t row, Py_ssize_t begin, Py_ssize_t end, Run* run, bint same_scan) noexcept nogil
    cdef void _update_children(self, Py_ssize_t row, Py_ssize_t begin, Py_ssize_t end, bint same_scan) noexcept nogil
    cdef void _record_hits(self, Py_ssize_t begin, Py_ssize_t end) noexcept nogil
    cdef void _raise_states(self, Py_ssize_t begin, Py_ssize_t end, unsigned char state) noexcept nogil
    cdef void _update_residuals(self, Leaf* leaf, Py_ssize_t begin, Py_ssize_t end, Run* run) noexcept nogil
    cdef bint _shows_mound(self, Py_ssize_t begin, Py_ssize_t end, double variance, double sign) noexcept nogil
    cdef void _update_statistics(self, Leaf* leaf, Py_ssize_t begin, Py_ssize_t end, Run* run) noexcept nogil
