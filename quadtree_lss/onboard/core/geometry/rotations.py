# SPDX-License-Identifier: Apache-2.0
"""Rotations in 3D, SO(3): matrices, rotation vectors and unit quaternions (x, y, z, w)."""

from __future__ import annotations

from math import atan2, cos, hypot, sin

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array


def skew(vectors: ArrayLike) -> Array:
    """Return the matrices with ``skew(a) @ b == cross(a, b)``: (..., 3) to (..., 3, 3)."""
    v = np.asarray(vectors, dtype=np.float64)
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2] = -v[..., 2], v[..., 1]
    out[..., 1, 0], out[..., 1, 2] = v[..., 2], -v[..., 0]
    out[..., 2, 0], out[..., 2, 1] = -v[..., 1], v[..., 0]
    return out


def exp(rotation_vectors: ArrayLike) -> Array:
    """Convert rotation vectors, rad, to matrices (Rodrigues): (..., 3) to (..., 3, 3)."""
    v = np.asarray(rotation_vectors, dtype=np.float64)
    angle = np.linalg.norm(v, axis=-1)[..., None, None]
    k = skew(v)
    first = np.sinc(angle / np.pi)
    second = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    out: Array = np.eye(3) + first * k + second * k @ k
    return out


def log(rotations: ArrayLike) -> Array:
    """Convert matrices to rotation vectors, rad, of length at most pi: (..., 3, 3) to (..., 3)."""
    quaternion = quaternion_from_rotation(rotations)
    vector, scalar = quaternion[..., :3], quaternion[..., 3:]
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    # The result of np.arctan2 differs between CPUs with and without AVX-512.
    half = np.frompyfunc(atan2, 2, 1)(sine, scalar).astype(np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        factor = np.where(sine > 1e-12, 2.0 * half / sine, 2.0)
    return vector * factor


def rotation_from_quaternion(quaternions_xyzw: ArrayLike) -> Array:
    """Convert unit quaternions to rotation matrices: (..., 4) to (..., 3, 3)."""
    q = np.asarray(quaternions_xyzw, dtype=np.float64)
    # For the single quaternion of a pose, Python floats take a tenth of the time of arrays.
    x, y, z, w = q.tolist() if q.ndim == 1 else np.moveaxis(q, -1, 0)
    scale = 2.0 / (x * x + y * y + z * z + w * w)
    xx, yy, zz = scale * x * x, scale * y * y, scale * z * z
    xy, xz, yz = scale * x * y, scale * x * z, scale * y * z
    wx, wy, wz = scale * w * x, scale * w * y, scale * w * z
    rows = np.array(
        (
            (1.0 - yy - zz, xy - wz, xz + wy),
            (xy + wz, 1.0 - xx - zz, yz - wx),
            (xz - wy, yz + wx, 1.0 - xx - yy),
        )
    )
    return rows if q.ndim == 1 else np.moveaxis(rows, (0, 1), (-2, -1))


def quaternion_from_rotation(rotations: ArrayLike) -> Array:
    """Convert rotation matrices to unit quaternions with w >= 0: (..., 3, 3) to (..., 4).

    The largest of the four components is computed first, so that no division is ill-conditioned.
    """
    r = np.asarray(rotations, dtype=np.float64)
    # For the single matrix of a pose, Python floats take a third of the time of arrays.
    (xx, x_y, x_z), (y_x, yy, y_z), (z_x, z_y, zz) = (
        r.tolist() if r.ndim == 2 else np.moveaxis(r, (-2, -1), (0, 1))
    )
    trace = xx + yy + zz
    squares = [1.0 + 2.0 * xx - trace, 1.0 + 2.0 * yy - trace, 1.0 + 2.0 * zz - trace, 1.0 + trace]
    rows = (
        (squares[0], x_y + y_x, x_z + z_x, z_y - y_z),
        (x_y + y_x, squares[1], y_z + z_y, x_z - z_x),
        (x_z + z_x, y_z + z_y, squares[2], y_x - x_y),
        (z_y - y_z, x_z - z_x, y_x - x_y, squares[3]),
    )
    q: Array
    if r.ndim == 2:
        q = np.array(rows[squares.index(max(squares))])
    else:
        best = np.argmax(squares, axis=0)
        stacked = np.moveaxis(np.array(rows), (0, 1), (-2, -1))
        q = np.take_along_axis(stacked, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(q[..., 3:] < 0.0, -q, q)


def slerp(start: ArrayLike, end: ArrayLike, fraction: float) -> Array:
    """Interpolate between two rotation matrices (3, 3) at constant rate; ``fraction``: 0 .. 1."""
    r0, r1 = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    x, y, z, w = quaternion_from_rotation(r0.T @ r1).tolist()
    sine = hypot(x, y, z)
    half = fraction * atan2(sine, w)
    turn = sin(half) / sine if sine > 1e-12 else fraction
    return r0 @ rotation_from_quaternion((turn * x, turn * y, turn * z, cos(half)))
