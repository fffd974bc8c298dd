# SPDX-License-Identifier: Apache-2.0
from quadtree_lss.onboard.core.mapping.features cimport Heights
from quadtree_lss.onboard.core.mapping.measure cimport Run

cdef class Room:
    cdef Py_ssize_t points, cells
    cdef Py_ssize_t[::1] begins, rows
    cdef double[::1] residual, ratios, weights
    cdef object ratio
    cdef Heights heights
    cdef Run[::1] runs
    cpdef hold(self, Py_ssize_t points)
    cpdef hold_runs(self, Py_ssize_t cells)
