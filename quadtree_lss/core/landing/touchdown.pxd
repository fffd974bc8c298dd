cimport cython
from libc.math cimport fabs, sqrt

cdef enum:
    #: Side of the blocks of grid points that are judged together.
    BLOCK = 8
    UNKNOWN = -1
    FAILS = 1
    #: Higher than any ground over a plane near it, m.
    FAR = 1000000000

cdef double ROUNDING, SAG, SHAPE


@cython.final
cdef class Lander:
    cdef readonly double side, radius, pad_radius, limit, steepest, plane_x, plane_y
    cdef readonly Py_ssize_t yaws, reach, width, blocks, highs, nears, spoiler, heading
    cdef readonly bint bounded
    cdef double[:, :, ::1] ground
    cdef double[::1] cos, sin, offset
    cdef Py_ssize_t[::1] pad_place, half, begin, which
    cdef Py_ssize_t[:, ::1] high
    cdef float[::1] away, pad_x, pad_y, top, pad, slope_x, slope_y, run, floor, spread, roof, height
    cdef float[:, ::1] stand, near

    cpdef void stand_on(
        self,
        double[:, ::1] elevation,
        double[:, ::1] slope_x,
        double[:, ::1] slope_y,
        double[:, ::1] subscale,
    )
    cpdef void judge(
        self,
        const unsigned char[:, ::1] due,
        const unsigned char[:, ::1] changed,
        signed char[:, ::1] verdict,
        Py_ssize_t block,
    )
    cdef void judge_block(
        self,
        const unsigned char[:, ::1] due,
        bint forget,
        signed char[:, ::1] verdict,
        Py_ssize_t row,
        Py_ssize_t column,
    ) noexcept nogil
    cdef void load(self, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef void set_down(self) noexcept nogil
    cdef void cover(self) noexcept nogil
    cdef bint fails(self, Py_ssize_t row, Py_ssize_t column) noexcept nogil
    cdef bint fails_somewhere(self, Py_ssize_t place) noexcept nogil
    cdef void gather(
        self,
        Py_ssize_t row,
        Py_ssize_t column,
        double above,
        Py_ssize_t first,
        Py_ssize_t last,
    ) noexcept nogil
    cdef bint rests_badly(
        self, Py_ssize_t heading, double centre, double along, double across
    ) noexcept nogil
