cpdef void disc_moments(
    double[:, ::1] cells,
    Py_ssize_t[::1] half,
    double[:, ::1] total,
    double[:, ::1] along_x,
    double[:, ::1] along_y,
)
cpdef void find_nearest(
    const unsigned char[:, ::1] marked, int[:, ::1] square, int[:, ::1] place
)
