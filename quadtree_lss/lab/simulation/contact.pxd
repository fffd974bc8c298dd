from libc.math cimport INFINITY, ceil, sqrt

cdef double TOLERANCE

cpdef void stand(
    const double[:, ::1] elevation,
    const double[::1] frame,
    const double[:, ::1] points,
    const double[:, ::1] heading,
    double radius,
    double pad_radius,
    double[:, ::1] worst,
)
cdef double under_pad(
    const double[:, ::1] elevation,
    const double[::1] frame,
    double x,
    double y,
    double radius,
) noexcept nogil
cdef Py_ssize_t first_post(double place, double reach, double origin, double step) noexcept nogil
