cdef long long PLACE_BITS, PLACE_MASK, DIGIT_BITS

cpdef long long encode(long long ix, long long iy) noexcept nogil
cdef long long spread(long long value) noexcept nogil
cpdef long long squeeze(long long code) noexcept nogil
cpdef bint sort_packed(long long[::1] packed, long long[::1] spare) noexcept
cdef void by_digit(
    long long[::1] source, long long[::1] target, long long low, long long count
) noexcept nogil
