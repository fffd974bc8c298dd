# SPDX-License-Identifier: Apache-2.0
cpdef double within(double z, double low, double high) noexcept nogil
cdef void keep_within(double[::1] z, double[::1] low, double[::1] high)
