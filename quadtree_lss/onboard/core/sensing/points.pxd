ctypedef fused Coordinate:
    float
    double

cpdef object transform_points(
    const Coordinate[:, :] points_lidar,
    int[::1] offsets,
    double[::1] times,
    double[:, ::1] motion,
    lidar,
    domain,
    position,
)
