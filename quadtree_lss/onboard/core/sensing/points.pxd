ctypedef fused Coordinate:
    float
    double

cdef class Workspace:
    cdef readonly object points_map, ranges, still
    cdef double[:, ::1] points
    cdef double[::1] flat, range, arranged
    cdef long long[::1] runs, spare, key
    cdef int[::1] begins
    cdef object _arranged, _key, _references
    cdef readonly Py_ssize_t missing, beyond, run_count
    cdef readonly bint above
    cpdef tuple output(self)

cpdef void transform_points(
    const Coordinate[:, :] points_lidar,
    int[::1] offsets,
    double[::1] times,
    double[:, ::1] motion,
    double min_range,
    double max_range,
    double west,
    double south,
    double per_metre,
    long long count,
    Workspace work,
)
cpdef bint any_beyond(const Coordinate[:, :] points, double limit)
cpdef Py_ssize_t sort_points(Workspace work, bint isolated, long long nowhere)
