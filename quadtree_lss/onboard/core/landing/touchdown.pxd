cimport cython

# Known when it is compiled: loops of so many steps take several at a time.
cdef enum:
    #: Side of the blocks of grid points that are judged together, and points of one.
    BLOCK = 8
    POINTS = 64
    #: Resting planes at a grid point: two for each heading (``config.limits.YAWS``).
    PLANES = 24
    #: Higher than any ground over a plane near it, m.
    FAR = 1000000000

@cython.final
cdef class Blocks:
    cdef double rounding, side, radius, pad_radius, corner
    cdef double low_rise, high_rise, worst_rise, low_slope, high_slope, worst_slope, base_x, base_y
    # Of all grid points of a block: numbers, for POINTS times PLANES is no size to Cython.
    cdef float stand[3072]
    cdef float planes_x[1536]
    cdef float planes_y[1536]
    cdef float planes_z[768]
    cdef float steep[POINTS]
    cdef float sink[POINTS]
    cdef float fall_east[POINTS]
    cdef float fall_west[POINTS]
    cdef float fall_north[POINTS]
    cdef float fall_south[POINTS]
    cdef float most[POINTS]
    cdef float resting_x[PLANES]
    cdef float resting_y[PLANES]
    cdef float resting_z[PLANES]
    cdef Py_ssize_t reach, first, width, blocks, spoiler_row, spoiler_column
    cdef double[:, :, ::1] ground
    cdef float[:, :, ::1] slopes
    cdef double[::1] offset
    cdef Py_ssize_t[::1] pad_row, pad_column, half, columns
    cdef float[::1] pad_x, pad_y, top, pad, run
    cdef float[::1] cos, sin, highest, middle, away, aside, tilt
    cdef void judge_block(self, unsigned char[:, ::1] due, bint forget, float[:, :, ::1] worst, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef void load(self, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef void place_pads(self, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef void find_planes(self) noexcept nogil
    cdef void cover(self) noexcept nogil
    cdef void bound_rises(self) noexcept nogil
    cdef void find_worst(self, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef void find_rise(self, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef float rise_at(self, Py_ssize_t row, Py_ssize_t column, Py_ssize_t i, Py_ssize_t j, float worst) noexcept nogil

cdef float greatest(float* values) noexcept nogil
