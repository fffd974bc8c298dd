# SPDX-License-Identifier: Apache-2.0

cdef void basis_at(double* normal, double* out) noexcept nogil
cdef void exp_at(double* tangent, double* out) noexcept nogil
cdef void log_at(double* normal, double* out, double* jacobian) noexcept nogil
cdef void in_pole_axes(double* normal, double* reference, double* out) noexcept nogil
cdef void plus_at(double* normal, double* basis, double* tangent, double* out) noexcept nogil
cdef void minus_at(double* normal, double* reference, double* out, double* change) noexcept nogil
