from libc.math cimport INFINITY, NAN, sqrt

from quadtree_lss.onboard.core.geometry.morton cimport PLACE_BITS

cdef extern from * nogil:
    void prefetch "__builtin_prefetch" (const void* at)

ctypedef fused Coordinate:
    float
    double

cpdef void turn(
    const Coordinate[:, :] points_lidar,
    int[::1] offsets,
    double[::1] times,
    double[:, ::1] motion,
    double least,
    double most,
    double west,
    double south,
    double per_metre,
    long long count,
    long long[::1] spread,
    double[:, ::1] points,
    double[::1] ranges,
    long long[::1] runs,
    int[::1] begins,
    long long[::1] counts,
)
cpdef bint reach_beyond(const Coordinate[:, :] points, double limit)
cpdef Py_ssize_t arrange(
    double[::1] points,
    double[::1] ranges,
    bint isolated,
    long long[::1] runs,
    int[::1] begins,
    long long nowhere,
    double[::1] arranged,
    long long[::1] keys,
)
