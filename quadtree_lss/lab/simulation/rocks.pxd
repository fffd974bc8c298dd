from libc.math cimport sqrt

cpdef void lay(
    double[:, ::1] rocks,
    const double[::1] axis,
    const Py_ssize_t[:, ::1] posts,
    const double[:, ::1] stones,
    bint heaped,
)
