# SPDX-License-Identifier: Apache-2.0
"""Planes that are moved, carried to another tangent and fused (paper IV.B, IV.C).

A plane is n.(r - c) = d about an origin c near the ground, n_z > 0; its error is
e = (dphi_1, dphi_2, dd) as in ``planes``. Every function treats all planes at once: leading
dimension M.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.core.geometry import sphere_arrays as sphere
from quadtree_lss.core.geometry.planes import inverse_symmetric, upward

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: A fused plane steeper than both it was made of and than this n_z (78 deg) is a failed fusion.
OVERTURNED = 0.2


@dataclass(frozen=True)
class Planes:
    """Estimates of M planes (Eq. 37) with the two parts of their covariance (Eq. 38).

    Attributes:
        normal: (M, 3), up.
        d: (M,) about an origin that the owner knows, m.
        parts: (M, 2, 3, 3) covariance from range noise and covariance from pose error.
    """

    normal: Array
    d: Array
    parts: Array

    @classmethod
    def of(cls, normal: Array, d: Array, range_part: Array, pose_part: Array) -> Planes:
        """Planes with their two covariances (M, 3, 3) each."""
        return cls(normal, d, np.stack([range_part, pose_part], axis=1))

    @property
    def range_part(self) -> Array:
        """(M, 3, 3) covariance from range noise."""
        return self.parts[:, 0]

    @property
    def pose_part(self) -> Array:
        """(M, 3, 3) covariance from pose error."""
        return self.parts[:, 1]


def tangent_change(of: Array, to: Array) -> Array:
    """Linear map (M, 3, 3) of errors in the tangent at ``of`` (M, 3) to the tangent at ``to``.

    With w = R_to^T of, the error of (of [-] to) is dlog(w) R_to^T B_of dphi; dd stays.
    """
    turn = np.swapaxes(sphere.rotation_to(to), -1, -2)
    seen = (turn @ of[:, :, None])[:, :, 0]
    out = np.zeros((len(of), 3, 3))
    out[:, :2, :2] = sphere.log_jacobian(seen) @ (turn @ sphere.tangent_basis(of))
    out[:, 2, 2] = 1.0
    return out


def congruent(change: Array, covariance: Array) -> Array:
    """T C T^T for (..., 3, 3) each."""
    out: Array = change @ covariance @ change.swapaxes(-1, -2)
    return out


def shift_origin(normal: Array, d: Array, delta: Array) -> tuple[Array, Array]:
    """Move the origin of planes by ``delta`` (M, 3), m: exact value and linear map of the error.

    d' = d - n.delta, and as dn = B dphi, dd' = dd - (B^T delta).dphi.

    Returns:
        d' (M,) and T (M, 3, 3) with e' = T e.
    """
    change = np.zeros((len(normal), 3, 3))
    change[:, 0, 0] = change[:, 1, 1] = change[:, 2, 2] = 1.0
    basis = sphere.tangent_basis(normal)
    change[:, 2, :2] = -np.einsum("mij,mi->mj", basis, delta)
    return d - np.einsum("mi,mi->m", normal, delta), change


def move_up(normal: Array, covariance: Array, delta_z: Array) -> Array:
    """Covariance (M, 3, 3) or (M, K, 3, 3) after moving the origin up by ``delta_z`` (M,), m.

    The vertical case of ``shift_origin``: B^T (0, 0, 1) = -(n_x, n_y), so
    dd' = dd + delta_z (n_x, n_y).dphi.
    """
    lever = normal[:, :2] * delta_z[:, None]
    if covariance.ndim == 4:
        lever = lever[:, None]
    out = covariance.copy()
    added = lever[..., :1] * covariance[..., :2, 0]
    added += lever[..., 1:] * covariance[..., :2, 1]
    crossed = covariance[..., :2, 2] + added
    out[..., :2, 2] = out[..., 2, :2] = crossed
    out[..., 2, 2] += (lever * (crossed + covariance[..., :2, 2])).sum(axis=-1)
    return out


def fuse_pair(prior: Planes, update: Planes, height: Array | None = None) -> Planes:
    """Two estimates of each plane made one, the parts of their covariance carried along.

    Eq. 39 is the error, Eq. 40, Eq. 41 and Eq. 42 the least squares, Eq. 43, Eq. 44 and Eq. 45 what
    comes of it:

    e = (n_update [-] n_prior, d_update - d_prior) in the prior's tangent; with the total
    covariances P and R: K = P (P + R)^-1, fused = prior [+] K e, and each part of the covariance
    becomes (I - K) P_part (I - K)^T + K R_part K^T, which sums to (P^-1 + R^-1)^-1.

    Where both normals are so uncertain that the linear step overturns the plane (steeper than
    either and n_z below ``OVERTURNED``), the update takes the prior's place.

    Args:
        prior, update: M planes each.
        height: (M,) of the update's origin above the prior's, m; the same origin by default.

    Returns:
        Planes about the prior's origin.
    """
    turn = sphere.rotation_to(prior.normal)
    back = turn.swapaxes(-1, -2)
    seen = (back @ update.normal[:, :, None])[:, :, 0]
    change = np.zeros((len(seen), 1, 3, 3))
    change[:, 0, :2, :2] = sphere.log_jacobian(seen) @ (back @ sphere.tangent_basis(update.normal))
    change[:, 0, 2, 2] = 1.0
    d = update.d
    if height is not None:
        d = d + update.normal[:, 2] * height
        change[:, 0, 2, :2] = -height[:, None] * update.normal[:, :2]
    error = np.empty((len(seen), 3))
    error[:, :2] = sphere.log(np.where(seen[:, 2:] < 0.0, -seen, seen))
    error[:, 2] = d - prior.d
    moved = congruent(change, update.parts)
    total = prior.parts[:, 0] + prior.parts[:, 1]
    gain = total @ inverse_symmetric(total + moved[:, 0] + moved[:, 1])
    step = (gain @ error[:, :, None])[:, :, 0]
    gain = gain[:, None]
    fused = Planes(
        upward((turn @ sphere.exp(step[:, :2])[:, :, None])[:, :, 0]),
        prior.d + step[:, 2],
        symmetric(congruent(np.eye(3) - gain, prior.parts) + congruent(gain, moved)),
    )
    over = fused.normal[:, 2] < OVERTURNED
    if over.any():
        over &= fused.normal[:, 2] < np.minimum(prior.normal[:, 2], update.normal[:, 2])
        parts = update.parts
        if height is not None:
            parts = move_up(update.normal, parts, -height)
        fused = _where(over, Planes(update.normal, d, parts), fused)
    return fused


def fuse_heights(prior: Planes, lever: Array, height: Array, noise: Array, pose: Array) -> Planes:
    """Fuse one orthogonal distance per plane: what too few points for a fit still tell.

    The mean residual A = n.(mean - c) - d of the points (Eq. 29) observes (B^T(c - mean), 1).e
    with variance noise + pose.

    Args:
        prior: M planes.
        lever: (M, 2) B^T (mean - origin), m.
        height: (M,) A, m.
        noise, pose: (M,) its variances from range noise and pose, m^2.

    Where the height would overturn an uncertain plane, the prior stays.
    """
    row = np.empty((len(lever), 3))
    row[:, :2] = -lever
    row[:, 2] = 1.0
    total = prior.parts[:, 0] + prior.parts[:, 1]
    image = (total @ row[:, :, None])[:, :, 0]
    gain = image / ((row * image).sum(axis=1) + noise + pose)[:, None]
    step = gain * height[:, None]
    rest = np.eye(3) - gain[:, :, None] * row[:, None, :]
    parts = symmetric(congruent(rest[:, None], prior.parts))
    square = gain[:, :, None] * gain[:, None, :]
    parts[:, 0] += noise[:, None, None] * square
    parts[:, 1] += pose[:, None, None] * square
    fused = Planes(upward(sphere.plus(prior.normal, step[:, :2])), prior.d + step[:, 2], parts)
    over = fused.normal[:, 2] < OVERTURNED
    if over.any():
        fused = _where(over & (fused.normal[:, 2] < prior.normal[:, 2]), prior, fused)
    return fused


def _where(chosen: Mask, these: Planes, others: Planes) -> Planes:
    """``these`` where chosen (M,), ``others`` elsewhere."""
    return Planes(
        np.where(chosen[:, None], these.normal, others.normal),
        np.where(chosen, these.d, others.d),
        np.where(chosen[:, None, None, None], these.parts, others.parts),
    )


def symmetric(matrices: Array) -> Array:
    """Mean of (..., K, K) and its transpose."""
    out: Array = 0.5 * (matrices + matrices.swapaxes(-1, -2))
    return out


def sound(covariance: Array) -> Array:
    """Covariances (M, 3, 3) freed of what round-off may do to extreme ones.

    Variances are kept positive; where the correlations are impossible, the nearest possible ones
    (no negative eigenvalue) take their place.
    """
    out = symmetric(covariance)
    variance = np.maximum(np.einsum("mii->mi", out), 1e-18)
    np.einsum("mii->mi", out)[...] = variance
    inverse = 1.0 / np.sqrt(variance)
    b = out[:, 0, 1] * inverse[:, 0] * inverse[:, 1]
    c = out[:, 0, 2] * inverse[:, 0] * inverse[:, 2]
    e = out[:, 1, 2] * inverse[:, 1] * inverse[:, 2]
    determinant = 1.0 + 2.0 * b * c * e - b * b - c * c - e * e
    apart = np.maximum(np.maximum(b * b, c * c), e * e)
    bad = np.flatnonzero((determinant < -1e-9) | (apart > 1.0 + 1e-9))
    if len(bad):
        scale = inverse[bad, :, None] * inverse[bad, None, :]
        values, vectors = np.linalg.eigh(np.clip(out[bad] * scale, -1.0, 1.0))
        kept = (vectors * np.maximum(values, 1e-12)[:, None, :]) @ vectors.transpose(0, 2, 1)
        out[bad] = kept / scale
    return out
