cdef enum:
    #: Bits of the index in the scan, the lower part of a packed number; the key is above.
    PLACE_BITS = 32

cdef extern from * nogil:
    void prefetch "__builtin_prefetch" (const void* at)

cpdef long long encode(long long ix, long long iy) noexcept nogil
cdef long long spread(long long value) noexcept nogil
cpdef long long compact(long long code) noexcept nogil
