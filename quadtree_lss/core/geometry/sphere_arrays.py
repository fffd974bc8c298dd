# SPDX-License-Identifier: Apache-2.0
"""Unit vectors without redundant parameters: the sphere S^2 (paper III.B, after Hertzberg).

A unit vector is n = (kappa, lambda) with kappa in the x-y plane (Eq. 1); its tangent space has
two dimensions. All functions take arrays of vectors, (..., 3), and of tangents, (..., 2), rad.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def rotation_to(normals: ArrayLike) -> Array:
    """Eq. 2: R_n with n = R_n (0, 0, 1): (..., 3) to (..., 3, 3). Singular at n = (0, 0, -1)."""
    n = np.asarray(normals, dtype=np.float64)
    x, y, z = n[..., 0], n[..., 1], n[..., 2]
    f = 1.0 / (1.0 + z)
    out = np.empty((*n.shape, 3))
    out[..., 0, 0] = 1.0 - f * x * x
    out[..., 1, 1] = 1.0 - f * y * y
    out[..., 0, 1] = out[..., 1, 0] = -f * x * y
    out[..., 0, 2], out[..., 2, 0] = x, -x
    out[..., 1, 2], out[..., 2, 1] = y, -y
    out[..., 2, 2] = z
    return out


def tangent_basis(normals: ArrayLike) -> Array:
    """First two columns of Eq. 2, the axes of dphi in space: (..., 3) to (..., 3, 2)."""
    n = np.asarray(normals, dtype=np.float64)
    x, y, z = n[..., 0], n[..., 1], n[..., 2]
    f = 1.0 / (1.0 + z)
    out = np.empty((*n.shape, 2))
    out[..., 0, 0] = 1.0 - f * x * x
    out[..., 1, 1] = 1.0 - f * y * y
    out[..., 0, 1] = out[..., 1, 0] = -f * x * y
    out[..., 2, 0], out[..., 2, 1] = -x, -y
    return out


def exp(tangents: ArrayLike) -> Array:
    """Eq. 3: (sinc(phi) phi, cos(phi)), (..., 2) to (..., 3)."""
    phi = np.asarray(tangents, dtype=np.float64)
    angle = np.hypot(phi[..., 0], phi[..., 1])
    out = np.empty((*phi.shape[:-1], 3))
    out[..., :2] = np.sinc(angle / np.pi)[..., None] * phi
    out[..., 2] = np.cos(angle)
    return out


def log(normals: ArrayLike) -> Array:
    """Eq. 4: angle from the z axis along kappa, (..., 3) to (..., 2)."""
    n = np.asarray(normals, dtype=np.float64)
    sine = np.hypot(n[..., 0], n[..., 1])
    angle = np.arctan2(sine, n[..., 2])
    small = sine < 1e-12
    factor = np.where(small, 1.0, angle / np.where(small, 1.0, sine))
    out: Array = factor[..., None] * n[..., :2]
    return out


def exp_jacobian(tangents: ArrayLike) -> Array:
    """Eq. 5, Eq. 6, Eq. 7 (bottom row -sinc(phi) phi^T): d exp / d phi, (..., 2) to (..., 3, 2)."""
    phi = np.asarray(tangents, dtype=np.float64)
    angle = np.hypot(phi[..., 0], phi[..., 1])
    sinc = np.sinc(angle / np.pi)
    small = angle < 1e-4
    square = np.where(small, 1.0, angle) ** 2
    chi = np.where(small, -1.0 / 3.0 + angle**2 / 30.0, (np.cos(angle) - sinc) / square)
    out = np.empty((*phi.shape[:-1], 3, 2))
    out[..., :2, :] = chi[..., None, None] * phi[..., :, None] * phi[..., None, :]
    out[..., 0, 0] += sinc
    out[..., 1, 1] += sinc
    out[..., 2, :] = -sinc[..., None] * phi
    return out


def log_jacobian(normals: ArrayLike) -> Array:
    """d log / d n for changes of n along the sphere: (..., 3) to (..., 2, 3).

    With unit direction k = kappa / |kappa| and angle phi, a change dn turns the angle by
    lambda k.dkappa - |kappa| dlambda and moves across k by (phi / sin phi) of dkappa.
    """
    n = np.asarray(normals, dtype=np.float64)
    sine = np.hypot(n[..., 0], n[..., 1])
    small = sine < 1e-9
    safe = np.where(small, 1.0, sine)
    kx = np.where(small, 1.0, n[..., 0] / safe)
    ky = np.where(small, 0.0, n[..., 1] / safe)
    cosine = n[..., 2]
    across = np.where(small, 1.0, np.arctan2(sine, cosine) / safe)
    out = np.empty((*n.shape[:-1], 2, 3))
    out[..., 0, 0] = cosine * kx * kx + across * ky * ky
    out[..., 1, 1] = cosine * ky * ky + across * kx * kx
    out[..., 0, 1] = out[..., 1, 0] = (cosine - across) * kx * ky
    out[..., 0, 2] = -sine * kx
    out[..., 1, 2] = -sine * ky
    return out


def plus(normals: ArrayLike, tangents: ArrayLike) -> Array:
    """Eq. 8: n [+] phi = R_n exp(phi).

    An uncertain unit vector is its mean [+] a Gaussian tangent (Eq. 10, Eq. 11).
    """
    out: Array = (rotation_to(normals) @ exp(tangents)[..., None])[..., 0]
    return out


def minus(normals: ArrayLike, reference: ArrayLike) -> Array:
    """Eq. 9 (cases corrected) and Eq. 12: n [-] m, the tangent at m to n, or to -n if nearer.

    (n, d) and (-n, -d) are one plane, so both vectors are first turned to the upper half space
    and then towards one another; R_m is never formed near lambda = -1.
    """
    n = np.asarray(normals, dtype=np.float64)
    m = np.asarray(reference, dtype=np.float64)
    m_up = np.where(m[..., 2:] < 0.0, -m, m)
    same = np.sum(n * m_up, axis=-1, keepdims=True) >= 0.0
    turned = np.where(same, n, -n)
    back = np.swapaxes(rotation_to(m_up), -1, -2)
    return log((back @ turned[..., None])[..., 0])
