from libc.math cimport sqrt

cdef enum:
    #: Points of a row of which distances are looked for together.
    SPAN = 64

cpdef void disc_moments(
    double[:, ::1] cells,
    double level,
    Py_ssize_t[::1] half,
    const unsigned char[:, ::1] seen,
    double square,
    double[:, ::1] mean,
    double[:, ::1] along_x,
    double[:, ::1] along_y,
    double[:, ::1] steep,
)
cpdef void find_nearest(
    const unsigned char[:, ::1] marked, int[:, ::1] square, int[:, ::1] place
)
cpdef void find_distances(
    const unsigned char[:, ::1] marked, const double[::1] lengths, short far, double[:, ::1] out
)
cpdef void score_density(
    const double[:, ::1] slope,
    const double[:, ::1] near,
    const double[:, ::1] inside,
    const double[:, ::1] subscale,
    const int[:, ::1] leaf,
    const double[::1] of_leaf,
    const double[::1] weights,
    double[:, ::1] out,
)
