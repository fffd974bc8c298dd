cdef enum:
    #: A packed number holds a key above so many bits and a place in the scan below.
    PLACE_BITS = 32
    #: One pass of the sort takes at most so many bits of the key: its counters, 2048, fit the
    #: first cache.
    DIGIT_BITS = 11

cdef extern from * nogil:
    void prefetch "__builtin_prefetch" (const void* at)

cpdef long long encode(long long ix, long long iy) noexcept nogil
cdef long long spread(long long value) noexcept nogil
cpdef long long compact(long long code) noexcept nogil
cpdef bint sort_packed(long long[::1] packed, long long[::1] spare) noexcept
cdef void sort_by_digit(
    long long[::1] source, long long[::1] target, long long low, long long count
) noexcept nogil
