from libc.math cimport M_PI, erf, exp, fabs, sqrt
from quadtree_lss.onboard.core.geometry.bounds cimport within

cpdef void lay_out(
    Py_ssize_t[::1] row,
    Py_ssize_t[::1] column,
    Py_ssize_t[::1] width,
    double[::1] z,
    double[::1] low,
    double[::1] high,
    double[:, ::1] normal,
    double[:, ::1] feature,
    double side,
    int[:, ::1] leaf,
    double[:, :, ::1] layers,
)
cdef double bell_share(double x, double half, double sigma) noexcept nogil
