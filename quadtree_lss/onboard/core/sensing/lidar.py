# SPDX-License-Identifier: Apache-2.0
"""Lidar poses and measurements (paper III.C).

Lidar axes are those of Eq. 14: z boresight, x right, y down (``_optical`` in ROS).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quadtree_lss.onboard.arrays import Array

#: Greatest variance of a pose, m^2 and rad^2: above it, nothing is known.
MAX_VARIANCE = 1e6


@dataclass(frozen=True, repr=False)
class Pose:
    """Estimated lidar pose at one instant.

    Attributes:
        stamp_ns: Time in integer nanoseconds.
        position: (3,) lidar origin in the map frame, m.
        rotation_map_lidar: (3, 3) rotates lidar axes to map axes.
        covariance: (6, 6) of (x, y, z, rotation about the map's fixed axes), m and rad, as in
            ``geometry_msgs/PoseWithCovariance``. Eq. 16 perturbs about the lidar's axes instead:
            Sigma_R = R^T Sigma_fixed R.
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
        """Create a pose from the homogeneous transform of lidar points to the map.

        Args:
            matrix: (4, 4): rotation, position in the last column, m, and the row 0, 0, 0, 1.
            stamp_ns: Time of the scan.
            covariance: (6, 6) as above; None for the standard deviations below.
            position_sigma, attitude_sigma_deg: Standard deviation of each axis, m and deg.

        Raises:
            ValueError: not a rigid transform, or the covariance is not (6, 6) and finite.
        """
        t = np.array(matrix, dtype=np.float64)
        if t.shape != (4, 4) or not np.isfinite(t).all() or not np.allclose(t[3], (0, 0, 0, 1)):
            msg = "a pose is a (4, 4) matrix of finite numbers with the last row 0, 0, 0, 1"
            raise ValueError(msg)
        rotation = t[:3, :3]
        unit = np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4)
        if not unit or np.linalg.det(rotation) < 0.0:
            raise ValueError("the upper left (3, 3) of the matrix is not a rotation")
        left, _, right = np.linalg.svd(rotation)
        if covariance is None:
            sigmas = np.repeat([position_sigma, np.radians(attitude_sigma_deg)], 3)
            covariance = np.diag(sigmas**2)
        known = np.array(covariance, dtype=np.float64)
        if known.shape != (6, 6) or not np.isfinite(known).all():
            raise ValueError("a pose's covariance is a (6, 6) matrix of finite numbers")
        return cls(int(stamp_ns), t[:3, 3].copy(), np.asarray(left @ right), known)

    @property
    def matrix(self) -> Array:
        """Homogeneous transform (4, 4) of lidar points to the map."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.rotation_map_lidar, self.position
        return out

    def __repr__(self) -> str:
        x, y, z = self.position
        return f"<Pose: x {x:.3f}, y {y:.3f}, z {z:.3f} m at {self.stamp_ns} ns>"


def points_from_ranges(ranges: ArrayLike, azimuth: ArrayLike, elevation: ArrayLike) -> Array:
    """Convert ranges, m, and angles, rad, each (...), to points (..., 3) in lidar axes (Eq. 14)."""
    rho = np.asarray(ranges, dtype=np.float64)
    cos_el = np.cos(elevation)
    return np.stack(
        [rho * np.sin(azimuth) * cos_el, -rho * np.sin(elevation), rho * np.cos(azimuth) * cos_el],
        axis=-1,
    )


def clip_covariance(covariance: Array) -> Array:
    """Clip the eigenvalues of a covariance (K, K) to 0 .. `MAX_VARIANCE`."""
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.minimum(np.maximum(values, 0.0), MAX_VARIANCE))
    return np.asarray(root @ root.T)
