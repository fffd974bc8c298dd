from libc.math cimport log

cpdef void set_odds(
    const float[:, ::1] rise,
    const float[:, ::1] slope,
    const unsigned char[:, ::1] judged,
    const double[::1] rise_odds,
    const double[::1] slope_odds,
    const double[::1] low,
    double step,
    const double[::1] within,
    double[:, ::1] own,
    double[:, ::1] about,
)
cpdef void look_up(
    const double[:, ::1] own,
    const double[:, ::1] about,
    const unsigned char[:, ::1] judged,
    const double[:, ::1] table,
    double least,
    double step,
    double[:, ::1] out,
)
cpdef void blur(
    const double[:, ::1] risk, const double[::1] across, const double[::1] along, double[:, ::1] out
)
