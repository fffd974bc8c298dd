# SPDX-License-Identifier: Apache-2.0
"""Unit vectors with a minimal parametrisation: the sphere S^2 (paper III.B, after Hertzberg).

A unit vector is n = (kappa, lambda) with kappa in the x-y plane (Eq. 1); its tangent space has two
dimensions. A basis of the tangent has six numbers, the first axis and then the second; matrices are
stored row by row.
"""

from __future__ import annotations

from collections.abc import MutableSequence
from typing import TypeAlias

import cython
from cython.cimports.libc.math import atan2, cos, sin, sqrt

#: A C array of doubles that a kernel reads or writes in place.
Vector: TypeAlias = MutableSequence[float]


def basis_at(normal: Vector, out: Vector) -> None:
    """Compute the first two columns of Eq. 2, the tangent axes of dphi: n (3) to (6); n != -z."""
    x, y = normal[0], normal[1]
    share = 1.0 / (1.0 + normal[2])
    out[0] = 1.0 - share * x * x
    out[1] = out[3] = -share * x * y
    out[2] = -x
    out[4] = 1.0 - share * y * y
    out[5] = -y


def exp_at(tangent: Vector, out: Vector) -> None:
    """Compute Eq. 3, (sinc(phi) phi, cos(phi)): phi (2) to (3)."""
    square = tangent[0] * tangent[0] + tangent[1] * tangent[1]
    if square < 1e-2:
        # The series of sinc and cosine, exact to the last bit.
        along = 1.0 - square * (1.0 / 42.0) * (1.0 - square * (1.0 / 72.0))
        along = 1.0 - square * (1.0 / 6.0) * (1.0 - square * (1.0 / 20.0) * along)
        up = 1.0 - square * (1.0 / 30.0) * (1.0 - square * (1.0 / 56.0))
        up = 1.0 - square * (1.0 / 2.0) * (1.0 - square * (1.0 / 12.0) * up)
    else:
        angle = sqrt(square)
        along = sin(angle) / angle
        up = cos(angle)
    out[0] = along * tangent[0]
    out[1] = along * tangent[1]
    out[2] = up


def log_at(normal: Vector, out: Vector, jacobian: Vector) -> None:
    """Compute Eq. 4, the angle from the z axis along kappa, n (3) to (2), and d log / d n (2, 3).

    The Jacobian holds for changes of n along the sphere and is the inverse of d exp / d phi (Eq. 5,
    Eq. 6, Eq. 7): with unit direction k = kappa / |kappa| and angle phi, dn changes the angle by
    lambda k.dkappa - |kappa| dlambda, and moves across k by phi / sin phi times dkappa.
    """
    square = normal[0] * normal[0] + normal[1] * normal[1]
    sine = sqrt(square)
    x = normal[0] / sine if sine > 1e-9 else 1.0
    y = normal[1] / sine if sine > 1e-9 else 0.0
    if square < 1e-3 and normal[2] > 0.0:
        # The series of the arc sine, exact to the last bit.
        across = 3.0 / 40.0 + square * (5.0 / 112.0 + square * (35.0 / 1152.0))
        across = 1.0 + square * (1.0 / 6.0 + square * across)
    else:
        across = atan2(sine, normal[2]) / sine if sine > 1e-9 else 1.0
    out[0] = across * normal[0]
    out[1] = across * normal[1]
    jacobian[0] = normal[2] * x * x + across * y * y
    jacobian[1] = jacobian[3] = (normal[2] - across) * x * y
    jacobian[2] = -sine * x
    jacobian[4] = normal[2] * y * y + across * x * x
    jacobian[5] = -sine * y


def in_pole_axes(normal: Vector, reference: Vector, out: Vector) -> None:
    """Compute R_m^T n: n (3) in the axes whose pole is m (3)."""
    basis = cython.declare(cython.double[6])
    basis_at(reference, basis)
    out[0] = basis[0] * normal[0] + basis[1] * normal[1] + basis[2] * normal[2]
    out[1] = basis[3] * normal[0] + basis[4] * normal[1] + basis[5] * normal[2]
    out[2] = reference[0] * normal[0] + reference[1] * normal[1] + reference[2] * normal[2]


def plus_at(normal: Vector, basis: Vector, tangent: Vector, out: Vector) -> None:
    """Compute Eq. 8, n [+] phi = R_n exp(phi): n (3), basis at n (6), phi (2) to (3).

    An uncertain unit vector is its mean [+] a Gaussian tangent (Eq. 10, Eq. 11).
    """
    step = cython.declare(cython.double[3])
    exp_at(tangent, step)
    x, y, z = step[0], step[1], step[2]
    out[0] = x * basis[0] + y * basis[3] + z * normal[0]
    out[1] = x * basis[1] + y * basis[4] + z * normal[1]
    out[2] = x * basis[2] + y * basis[5] + z * normal[2]


def minus_at(normal: Vector, reference: Vector, out: Vector, change: Vector) -> None:
    """Compute Eq. 9 and Eq. 12, n [-] m in the tangent at m, both up: n (3), m (3) to (2).

    Also compute ``change`` (4), the linear map of errors from the tangent at n to the tangent at m:
    with w = R_m^T n, the error of (n [-] m) is dlog(w) R_m^T B_n dphi.
    """
    turned = cython.declare(cython.double[3])
    basis = cython.declare(cython.double[6])
    axis = cython.declare(cython.double[3])
    slope = cython.declare(cython.double[6])
    cython.declare(i=cython.int, k=cython.int)
    in_pole_axes(normal, reference, turned)
    log_at(turned, out, slope)
    basis_at(normal, basis)
    for i in range(2):
        for k in range(3):
            axis[k] = basis[3 * i + k]
        in_pole_axes(axis, reference, turned)
        for k in range(2):
            change[2 * k + i] = (
                slope[3 * k] * turned[0]
                + slope[3 * k + 1] * turned[1]
                + slope[3 * k + 2] * turned[2]
            )
