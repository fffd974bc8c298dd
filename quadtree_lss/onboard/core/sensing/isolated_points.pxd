from libc.math cimport NAN, sqrt

cpdef void second_distances(double[:, ::1] points, double[::1] distances) noexcept
cpdef Py_ssize_t linked_in_order(double[:, ::1] points, double[::1] ranges, double limit, unsigned char[::1] sure)
cdef long long cube_of(long long column, long long row, long long layer) noexcept nogil
cdef Py_ssize_t slot_of(long long[::1] cubes, long long cube) noexcept nogil
cpdef void fill(
    double[:, ::1] points,
    double[::1] ranges,
    double per_metre,
    long long[::1] cubes,
    int[::1] last,
    int[::1] before,
    int[::1] slots,
)
cpdef Py_ssize_t drop(
    double[:, ::1] points,
    double[::1] ranges,
    double limit,
    double per_metre,
    long long[::1] cubes,
    int[::1] last,
    int[::1] before,
    int[::1] slots,
    long long[:, ::1] around,
    unsigned char[::1] sure,
)
cdef Py_ssize_t point_links(
    double[:, ::1] points,
    Py_ssize_t point,
    double limit,
    double per_metre,
    long long[::1] cubes,
    int[::1] last,
    int[::1] before,
    long long[:, ::1] around,
    Py_ssize_t* linked,
) noexcept nogil
