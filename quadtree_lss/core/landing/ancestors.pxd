from libc.math cimport atan2, cos, fmax, sin, sqrt

cpdef void fuse_leaves(
    Py_ssize_t[::1] ancestor,
    double[:, ::1] centre,
    double[:, ::1] normal,
    double[:, :, ::1] range_part,
    double[:, :, ::1] pose_part,
    double[::1] weight,
    double[:, ::1] place,
    double[::1] z,
    double[:, ::1] fused,
    double[:, :, ::1] fused_range,
    double[:, :, ::1] fused_pose,
)
cdef void see_from(
    double* normal, double* arm, double* reference, double* change, double* error
) noexcept nogil
cdef void step_from(double* reference, double* step, double* normal) noexcept nogil
cdef void axes(double* normal, double* out) noexcept nogil
cdef double dot(double* a, double* b) noexcept nogil
cdef void congruent(double* change, double* covariance, double* out) noexcept nogil
cdef void invert(double* matrix, double* out) noexcept nogil
cdef double bounded(double correlation) noexcept nogil
