cimport cython
from libc.math cimport NAN, fabs, sqrt

cdef enum:
    #: Side of the blocks of grid points that are judged together.
    BLOCK = 8
    #: Heights that are told apart in the order of the cells.
    BINS = 32
    #: Higher than any ground over a plane near it, m.
    FAR = 1000000000

cdef double ROUNDING, SAG, SHAPE, STEP


@cython.final
cdef class Lander:
    cdef readonly double side, radius, pad_radius, plane_x, plane_y
    cdef readonly double low_rise, high_rise, low_slope, high_slope, worst_rise, worst_slope
    cdef readonly float least_x, most_x, least_y, most_y, least_z
    cdef readonly Py_ssize_t yaws, reach, width, blocks, highs, spoiler
    cdef readonly bint bounded
    cdef double[:, :, ::1] ground
    cdef double[::1] offset
    cdef Py_ssize_t[::1] pad_place, half, begin
    cdef float[::1] pad_x, pad_y, top, pad, slope_x, slope_y, run, floor, spread, roof, height, most
    cdef float[::1] rest_x, rest_y, rest_z, above, along, across, cos, sin
    cdef Py_ssize_t[:, ::1] high
    cdef float[:, ::1] stand

    cpdef void stand_on(
        self,
        double[:, ::1] elevation,
        double[:, ::1] slope_x,
        double[:, ::1] slope_y,
        double[:, ::1] subscale,
        unsigned char[:, ::1] changed,
    )
    cpdef void judge(
        self,
        const unsigned char[:, ::1] due,
        const unsigned char[:, ::1] changed,
        float[:, :, ::1] rest,
        Py_ssize_t block,
    )
    cdef void judge_block(
        self,
        const unsigned char[:, ::1] due,
        bint forget,
        float[:, :, ::1] rest,
        Py_ssize_t row,
        Py_ssize_t column,
    ) noexcept nogil
    cdef void load(self, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef void set_down(self) noexcept nogil
    cdef void cover(self) noexcept nogil
    cdef void list_highs(self, double above) noexcept nogil
    cdef void set_worst(self, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef void settle(self, Py_ssize_t place) noexcept nogil
    cdef void bound_rests(self) noexcept nogil
    cdef void gather(
        self,
        Py_ssize_t row,
        Py_ssize_t column,
        Py_ssize_t first,
        Py_ssize_t last,
    ) noexcept nogil
    cdef bint rise_at(self, Py_ssize_t k, float east, float north) noexcept nogil

cdef Py_ssize_t bin_of(double height) noexcept nogil
