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
    cdef Py_ssize_t reach, width
    cdef Py_ssize_t[::1] half, pad_row, pad_column, pad_cell
    cdef double[:, ::1] ground, highest
    cdef double[::1] offset, share, pad_x, pad_y, cos, sin, excess, bound_y
    cdef double pad_z[4 * HEADINGS * SPAN]
    cdef double plane_x[2 * HEADINGS * SPAN]
    cdef double plane_y[2 * HEADINGS * SPAN]
    cdef double plane_z[HEADINGS * SPAN]
    cdef double contact_x[2 * HEADINGS]
    cdef double contact_y[2 * HEADINGS]
    cdef double contact_z[2 * HEADINGS]
    cdef double steep[SPAN]
    cdef double max_excess[SPAN]
    cdef double z_low[SPAN]
    cdef double z_east[SPAN]
    cdef double z_west[SPAN]
    cdef double z_north[SPAN]
    cdef double z_south[SPAN]
    cdef void find_planes(self, Py_ssize_t cell) noexcept nogil
    cdef void bound_rises(self, Py_ssize_t column) noexcept nogil
    cdef double find_rise(self, Py_ssize_t cell, Py_ssize_t p) noexcept nogil
    cdef double cell_rise(self, Py_ssize_t cell, Py_ssize_t i, Py_ssize_t j) noexcept nogil
