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
    cdef bint bounded
    cdef float sink, fall_east, fall_west, fall_north, fall_south
    cdef float resting_x[PLANES]
    cdef float resting_y[PLANES]
    cdef float resting_z[PLANES]
    cdef Py_ssize_t yaws, reach, width, blocks, spoiler_row, spoiler_column
    cdef double[:, :, ::1] ground
    cdef double[::1] offset
    cdef Py_ssize_t[::1] pad_place, half
    cdef float[::1] pad_x, pad_y, top, pad, run, slope_x, slope_y, roof, floor, spread, stand
    cdef float[::1] cos, sin, highest, middle, away, aside
    cdef void judge_block(self, unsigned char[:, ::1] due, bint forget, float[:, :, ::1] worst, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef void load(self, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef void place_pads(self) noexcept nogil
    cdef void cover(self) noexcept nogil
    cdef void find_worst(self, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef void find_planes(self, Py_ssize_t place) noexcept nogil
    cdef void bound_planes(self) noexcept nogil
    cdef void find_rise(self, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef float rise_at(self, Py_ssize_t row, Py_ssize_t column, Py_ssize_t i, Py_ssize_t j, float worst) noexcept nogil

cdef float greatest(float* values) noexcept nogil
