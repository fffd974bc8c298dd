cdef enum:
    #: Bits of the index in the scan, the lower part of a packed number; the key is above.
    PLACE_BITS = 32
    #: Most bits of the key per pass of the sort: its 2048 counters fit into the L1 cache.
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
