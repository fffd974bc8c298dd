from libc.math cimport NAN, sqrt

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

cpdef void second_distances(double[:, ::1] points, double[::1] distances) noexcept
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
