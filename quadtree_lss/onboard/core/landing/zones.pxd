from libc.math cimport fabs, sqrt

cpdef void greatest_in_zones(
    const double[:, ::1] cells,
    const int[:, ::1] leaf,
    const double[::1] of_leaf,
    const Py_ssize_t[::1] half,
    const Py_ssize_t[:, ::1] places,
    double[:, ::1] out,
)
cpdef void lower_room(
    const unsigned char[:, ::1] marked,
    double half,
    const double[::1] x,
    const double[::1] y,
    double side,
    double reach,
    double[::1] room,
)
