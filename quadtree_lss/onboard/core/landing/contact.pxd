# SPDX-License-Identifier: Apache-2.0
cimport cython

cdef enum:
    #: Grid points of a row whose resting planes are computed together.
    SPAN = 16

@cython.final
cdef class ContactKernel:
    cdef double least_rise, most_tilt, corner
    cdef Py_ssize_t reach, width
    cdef Py_ssize_t[::1] half, pad_row, pad_column, pad_cell
    cdef double[:, ::1] ground
    cdef double[::1] offset, share, pad_x, pad_y, cos, sin, top, bound_x, bound_y
    # SPAN times the pads, the planes and the headings, of which there are config.limits.YAWS = 12.
    cdef double pad_z[768]
    cdef double plane_x[384]
    cdef double plane_y[384]
    cdef double plane_z[192]
    cdef double steep[SPAN]
    cdef double z_low[SPAN]
    cdef double z_east[SPAN]
    cdef double z_west[SPAN]
    cdef double z_north[SPAN]
    cdef double z_south[SPAN]
    cdef void find_planes(self, Py_ssize_t cell) noexcept nogil
    cdef double find_rise(self, Py_ssize_t cell, Py_ssize_t p) noexcept nogil
    cdef double raise_to(self, double rise, Py_ssize_t cell, Py_ssize_t p, Py_ssize_t i, Py_ssize_t j) noexcept nogil
