from libc.math cimport INFINITY, NAN, fabs, sqrt

cdef double NUDGE

cpdef void march(
    const double[:, ::1] elevation,
    const double[:, ::1] far,
    const double[:, ::1] middle,
    const double[:, ::1] near,
    const double[::1] box,
    const double[::1] start,
    const double[:, ::1] speed,
    double[::1] ranges,
)
cdef double free_way(
    double clear, double window, double per_post, double per_height
) noexcept nogil
cdef double ahead_in_cell(
    double f0, double f1, double f2, double cross
) noexcept nogil
