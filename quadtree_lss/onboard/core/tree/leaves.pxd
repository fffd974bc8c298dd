# SPDX-License-Identifier: Apache-2.0
cimport cython

cpdef enum:
    UNKNOWN, INCOMPLETE, INHERITED, ESTIMATED

cpdef enum:
    OBSERVED = 1, EXPLAINED, UNEXPLAINED

#: Of ``bias``: behind t t^T.
cpdef enum:
    LIFT = 3, WEIGHT

cdef struct Leaf:
    int level
    int ix
    int iy
    int state
    double x
    double y
    double z
    double first_time
    double last_time
    double normal[3]
    double range_part[9]
    double pose_part[9]
    double points
    double distance_sum
    double noise_sum
    double exception_sum
    double exception_noise
    double residuals
    double division_sum
    double division_weight
    double square_sum
    double low
    double high
    double greatest
    double strip_width
    double parent_misfit
    double bias[5]
    double feature[5]
    double feature_information[25]

cdef double NO_SLOPE

cdef void reset_statistics(Leaf* leaf) noexcept nogil

@cython.final
cdef class LeafTable:
    cdef readonly object domain
    cdef readonly object rows
    cdef readonly object leaf_of
    cdef Leaf[::1] leaf
    cdef int[::1] over
    cdef readonly object observed
    cdef unsigned char[::1] seen
    cdef readonly object piled
    cdef float[:, ::1] pile
    cdef readonly object hit_parts
    cdef unsigned short[::1] hits
    cdef readonly Py_ssize_t count
    cdef readonly Py_ssize_t capacity
    cdef readonly Py_ssize_t max_cells
    cdef readonly int max_level
    cdef double xmin, ymin
    cdef double sides[32]
    cdef void prefetch_header(self, Py_ssize_t row) noexcept nogil
    cdef void prefetch_leaf(self, Py_ssize_t row) noexcept nogil
    cdef Leaf* at(self, Py_ssize_t row) noexcept nogil
    cdef void _place(self, Py_ssize_t row, int level, int ix, int iy) noexcept nogil
    cdef bint unmark_moved(self, Leaf* leaf, double rise, double slope_x, double slope_y, double limit) noexcept nogil
    cdef void reset_leaf(self, Leaf* leaf) noexcept nogil
    cdef bint _stands_out(self, int level, int ix, int iy) noexcept nogil
    cpdef bint divide(self, Py_ssize_t row, double square, double tilt, double spread, double parent_misfit) noexcept nogil
    cpdef reserve(self, Py_ssize_t more)

cpdef leaf_raster(unsigned char[::1] level, unsigned int[::1] ix, unsigned int[::1] iy, int[:, ::1] out)
