# SPDX-License-Identifier: Apache-2.0
cimport cython

cdef enum:
    #: Grid points of a row whose contact planes are computed together.
    SPAN = 16
    #: Headings of the vehicle, `config.limits.YAWS`.
    HEADINGS = 12

@cython.final
cdef class ContactKernel:
    cdef double min_rise, max_tilt, corner, pad_radius, half_side
    cdef Py_ssize_t reach, width, highest_row, highest_column
    cdef Py_ssize_t[::1] half, pad_row, pad_column, pad_cell
    cdef double[:, ::1] ground, highest
    cdef double[::1] offset, share, pad_x, pad_y, cos, sin, excess, bound_y
    cdef double pad_z[4 * HEADINGS * SPAN], plane_z[HEADINGS * SPAN]
    cdef double plane_x[2 * HEADINGS * SPAN], plane_y[2 * HEADINGS * SPAN]
    cdef double contact_x[2 * HEADINGS], contact_y[2 * HEADINGS], contact_z[2 * HEADINGS]
    cdef double steep[SPAN], max_excess[SPAN], z_low[SPAN]
    cdef double z_east[SPAN], z_west[SPAN], z_north[SPAN], z_south[SPAN]
    cdef void find_planes(self, Py_ssize_t cell) noexcept nogil
    cdef void bound_rises(self, Py_ssize_t column) noexcept nogil
    cdef double find_rise(self, Py_ssize_t cell, Py_ssize_t p) noexcept nogil
    cdef double cell_rise(self, Py_ssize_t cell, Py_ssize_t i, Py_ssize_t j) noexcept nogil
