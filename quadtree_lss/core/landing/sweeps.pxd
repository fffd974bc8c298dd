cpdef void disc_sums(
    double[:, ::1] west, Py_ssize_t[::1] half, double[::1] weight, double[:, ::1] out
)
cpdef void find_nearest(
    const unsigned char[:, ::1] marked, long long[:, ::1] square, Py_ssize_t[:, ::1] place
)
