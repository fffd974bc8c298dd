from libc.math cimport INFINITY

cdef double step_to(
    double[:, ::1] ranges, Py_ssize_t row, Py_ssize_t column, Py_ssize_t k
) noexcept nogil
cdef Py_ssize_t pixel_links(
    double[:, ::1] ranges, Py_ssize_t row, Py_ssize_t column, double limit
) noexcept nogil
cdef bint pixel_holds(
    double[:, ::1] ranges, Py_ssize_t row, Py_ssize_t column, double limit
) noexcept nogil
cpdef Py_ssize_t pixels_with_few_links(
    double[:, ::1] ranges, double limit, int[::1] pixels
) noexcept
cpdef Py_ssize_t pixels_without_hold(
    double[:, ::1] ranges, double limit, int[::1] pixels
) noexcept
cpdef Py_ssize_t second_steps(
    double[:, ::1] ranges, int[::1] pixels, double[::1] steps
) noexcept
