# SPDX-License-Identifier: Apache-2.0
cimport cython

@cython.final
cdef class ContactKernel:
    cdef double least_rise, most_tilt, corner, z_low, z_east, z_west, z_north, z_south
    cdef Py_ssize_t reach, width
    cdef Py_ssize_t[::1] half, pad_row, pad_column, pad_cell
    cdef double[:, ::1] ground
    cdef double[::1] offset, pad_x, pad_y, cos, sin, top
    cdef double[::1] pad_z, plane_x, plane_y, plane_z, bound_x, bound_y
    cdef double find_planes(self, Py_ssize_t cell) noexcept nogil
    cdef double find_rise(self, Py_ssize_t cell) noexcept nogil
    cdef double raise_to(self, double rise, Py_ssize_t cell, Py_ssize_t i, Py_ssize_t j) noexcept nogil
