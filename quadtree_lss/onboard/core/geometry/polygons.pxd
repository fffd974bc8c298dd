from libc.math cimport INFINITY, sqrt

cpdef void set_distances(
    const double[:, ::1] edges, const double[::1] x, const double[::1] y, double[::1] out
)
