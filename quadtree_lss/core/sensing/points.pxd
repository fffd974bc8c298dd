from libc.math cimport NAN, sqrt

from quadtree_lss.core.geometry.morton cimport PLACE_BITS, PLACE_MASK

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
    double[:, ::1] points,
    double[::1] ranges,
    long long[::1] lost,
)
cpdef bint reach_beyond(const Coordinate[:, :] points, double limit)
cpdef void bin_runs(
    double[:, ::1] points,
    double[::1] ranges,
    double west,
    double south,
    double per_metre,
    long long count,
    long long[::1] spread,
    long long[::1] runs,
    int[:, ::1] spans,
    long long[::1] found,
    double[::1] sums,
)
cpdef void arrange(
    double[:, ::1] points,
    long long[::1] runs,
    int[:, ::1] spans,
    double[:, ::1] arranged,
    long long[::1] keys,
)
