ctypedef fused Coordinate:
    float
    double

cdef class Workspace:
    cdef readonly double[:, ::1] points
    cdef readonly double[::1] ranges
    cdef long long[::1] runs, spare
    cdef int[::1] begins
    cdef Py_ssize_t size
    cdef readonly Py_ssize_t missing, beyond, run_count
    cdef readonly bint above
    cpdef resize(self, Py_ssize_t size)

cpdef void transform_points(
    const Coordinate[:, :] points_lidar,
    int[::1] offsets,
    double[::1] times,
    double[:, ::1] motion,
    lidar,
    domain,
    position,
    Workspace work,
)
