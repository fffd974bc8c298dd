# SPDX-License-Identifier: Apache-2.0
from libc.math cimport exp, fabs

cpdef double above(double deviations) noexcept nogil
