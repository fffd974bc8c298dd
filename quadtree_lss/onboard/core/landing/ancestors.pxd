from libc.math cimport sqrt
from quadtree_lss.onboard.core.geometry.plane cimport inverse_symmetric, keep_up, shift_origin, turn_tangent
from quadtree_lss.onboard.core.geometry.sphere cimport basis_at, minus_at, plus_at

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
