# SPDX-License-Identifier: Apache-2.0
"""Lidar measurements: from ranges to points in the map frame with their covariance (paper III.C).

Lidar axes are Eq. 14's: z boresight, x right, y down (ROS calls such a frame ``_optical``).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from quadtree_lss.core.geometry.rotations import skew

Array = NDArray[np.float64]

#: Variances (m^2, rad^2) above this say no more than this: nothing is known.
MAX_VARIANCE = 1e6


@dataclass(frozen=True, repr=False)
class Pose:
    """Estimated lidar pose at one instant.

    Attributes:
        stamp_ns: Time in integer nanoseconds.
        position: (3,) lidar origin in the map frame, m.
        rotation_map_lidar: (3, 3) takes lidar axes to map axes.
        covariance: (6, 6) of (x, y, z, rotation about the map's fixed X, Y, Z), m and rad,
            as in ``geometry_msgs/PoseWithCovariance``.
    """

    stamp_ns: int
    position: Array
    rotation_map_lidar: Array
    covariance: Array

    @classmethod
    def from_matrix(
        cls,
        matrix: ArrayLike,
        stamp_ns: int = 0,
        *,
        covariance: ArrayLike | None = None,
        position_sigma: float = 0.1,
        attitude_sigma_deg: float = 0.05,
    ) -> Pose:
        """A pose from the homogeneous transform that takes points of the lidar to the map.

        Args:
            matrix: (4, 4): rotation, position in the last column, m, and the row 0, 0, 0, 1.
            stamp_ns: Time of the scan.
            covariance: (6, 6) as above; None takes the two standard deviations, of each axis.
            position_sigma, attitude_sigma_deg: m, deg.

        Raises:
            ValueError: the matrix is no rotation with a translation, or the covariance is not
                (6, 6) and finite.
        """
        t = np.array(matrix, dtype=np.float64)
        if t.shape != (4, 4) or not np.isfinite(t).all() or not np.allclose(t[3], (0, 0, 0, 1)):
            msg = "a pose is a (4, 4) matrix of finite numbers with the last row 0, 0, 0, 1"
            raise ValueError(msg)
        rotation = t[:3, :3]
        unit = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
        if not unit or np.linalg.det(rotation) < 0.0:
            msg = "the upper left (3, 3) of the matrix is not a rotation"
            raise ValueError(msg)
        left, _, right = np.linalg.svd(rotation)
        if covariance is None:
            sigmas = np.repeat([position_sigma, np.radians(attitude_sigma_deg)], 3)
            covariance = np.diag(sigmas**2)
        known = np.array(covariance, dtype=np.float64)
        if known.shape != (6, 6) or not np.isfinite(known).all():
            msg = "a pose's covariance is a (6, 6) matrix of finite numbers"
            raise ValueError(msg)
        return cls(int(stamp_ns), t[:3, 3].copy(), np.asarray(left @ right), known)

    @property
    def matrix(self) -> Array:
        """(4, 4) that takes points in lidar axes to the map."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation_map_lidar, self.position
        return out

    def __repr__(self) -> str:
        x, y, z = self.position
        return f"<Pose: x {x:.3f}, y {y:.3f}, z {z:.3f} m at {self.stamp_ns} ns>"


def points_from_ranges(ranges: ArrayLike, azimuth: ArrayLike, elevation: ArrayLike) -> Array:
    """Eq. 14: ranges in m and angles in rad, each (...), to points (..., 3) in lidar axes."""
    rho = np.asarray(ranges, dtype=np.float64)
    cos_el = np.cos(elevation)
    return np.stack(
        [
            rho * np.sin(azimuth) * cos_el,
            -rho * np.sin(elevation),
            rho * np.cos(azimuth) * cos_el,
        ],
        axis=-1,
    )


def fixed_from_body_covariance(
    sigma_position: Array, sigma_rotation: Array, rotation: Array
) -> Array:
    """Fixed-axis 6x6 covariance of a pose perturbed as in Eq. 16.

    Eq. 16 perturbs on the right, in lidar axes: R_hat = R exp(dR). About the map's axes the same
    error is R dR, so Sigma_fixed = R Sigma_R R^T.

    Args:
        sigma_position: (3, 3) position covariance, map axes, m^2.
        sigma_rotation: (3, 3) covariance of dR in lidar axes, rad^2.
        rotation: (3, 3) rotation_map_lidar.
    """
    out = np.zeros((6, 6))
    out[:3, :3] = sigma_position
    out[3:, 3:] = rotation @ sigma_rotation @ rotation.T
    return out


def body_from_fixed_covariance(covariance: Array, rotation: Array) -> Array:
    """Inverse of the above with the cross block: Sigma_R = R^T Sigma_fixed R, Sigma_m,fixed R."""
    t = np.eye(6)
    t[3:, 3:] = rotation.T
    return t @ covariance @ t.T


def sound_covariance(covariance: Array) -> Array:
    """A covariance (K, K) made positive semidefinite and bounded: eigenvalues 0 .. 1e6."""
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.clip(values, 0.0, MAX_VARIANCE))
    out: Array = root @ root.T
    return out


def point_covariances(points_map: Array, pose: Pose, range_noise: float) -> Array:
    """Eq. 17: covariance (N, 3, 3) in m^2 of points (N, 3) in map axes.

    With the pose error (dm, dw) about fixed axes, dr = dm + dw x (r - m), and the range error
    moves the point along its ray u: Sigma_r = J Sigma_pose J^T + sigma^2 u u^T with
    J = [I, -[r - m]_x].
    """
    arm = points_map - pose.position
    jacobian = np.concatenate([np.broadcast_to(np.eye(3), (len(arm), 3, 3)), -skew(arm)], axis=-1)
    ray = arm / np.linalg.norm(arm, axis=-1, keepdims=True)
    along = range_noise**2 * ray[:, :, None] * ray[:, None, :]
    out: Array = jacobian @ pose.covariance @ jacobian.transpose(0, 2, 1) + along
    return out
