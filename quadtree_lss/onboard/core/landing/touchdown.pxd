cimport cython

# Known when it is compiled: loops of so many steps take several at a time.
cdef enum:
    #: Side of the blocks of grid points that are judged together.
    BLOCK = 8
    #: Heights that are told apart in the order of the cells.
    BINS = 32
    #: Higher than any ground over a plane near it, m.
    FAR = 1000000000

@cython.final
cdef class Blocks:
    cdef double step, rounding, side, radius, pad_radius
    cdef double low_rise, high_rise, worst_rise, low_slope, high_slope, worst_slope, base_x, base_y
    cdef bint bounded
    cdef float least_x, most_x, least_y, most_y, least_z
    cdef Py_ssize_t yaws, reach, width, blocks, highs, spoiler
    cdef double[:, :, ::1] ground
    cdef double[::1] offset
    cdef Py_ssize_t[::1] pad_place, half, begin
    cdef Py_ssize_t[:, ::1] high
    cdef float[:, ::1] stand
    cdef float[::1] pad_x, pad_y, top, pad, run, slope_x, slope_y, roof, floor, spread, height, most
    cdef float[::1] above, along, across, cos, sin, resting_x, resting_y, resting_z
    cdef void judge_block(self, unsigned char[:, ::1] due, bint forget, float[:, :, ::1] worst, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef void load(self, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef void place_pads(self) noexcept nogil
    cdef void cover(self) noexcept nogil
    cdef void list_highs(self, double above) noexcept nogil
    cdef void find_worst(self, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef void find_planes(self, Py_ssize_t place) noexcept nogil
    cdef void bound_planes(self) noexcept nogil
    cdef void find_rise(self, Py_ssize_t row, Py_ssize_t column, Py_ssize_t first, Py_ssize_t last) noexcept nogil
    cdef bint rise_at(self, Py_ssize_t k, float east, float north) noexcept nogil

cdef Py_ssize_t bin_of(double steps) noexcept nogil
