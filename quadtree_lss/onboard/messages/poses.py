# SPDX-License-Identifier: Apache-2.0
"""Validation of pose messages and conversion to ``core.sensing.lidar.Pose``."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np

from quadtree_lss.onboard.arrays import Array, Mask
from quadtree_lss.onboard.core.geometry.rotations import rotation_from_quaternion
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages.clouds import MessageError, stamp_ns

MAX_POSITION = 1e8
"""Limit of plausible positions, m."""

MAX_ATTITUDE_VARIANCE = 0.25
"""Poses with an attitude standard deviation above 0.5 rad are rejected, rad^2."""

UNKNOWN_VARIANCES = np.repeat([300.0**2, (2.0 * np.pi) ** 2], 3)
"""Larger variances mean "unknown", m^2 and rad^2: drivers send 1e6 on axes that they do not
estimate."""

UNIT_TOLERANCE = 0.01
"""Quaternions whose length differs from 1 by at most this are normalised."""

COVARIANCE_TOLERANCE = 1e-5
"""Relative asymmetry and negative eigenvalue that are corrected as single-precision rounding."""


def pose_from_message(
    msg: Any,
    map_frame: str,
    *,
    unknown_position_sigma: float = 0.1,
    unknown_attitude_sigma_deg: float = 0.05,
) -> Pose:
    """Return the pose of the lidar (or body) in the map frame.

    ``msg`` is like ``geometry_msgs/PoseWithCovarianceStamped`` or ``nav_msgs/Odometry``. Its frame
    must be ``map_frame``, except for a leading slash; its covariance is that of (x, y, z, rotation
    about the fixed axes of that frame), m and rad. The two sigmas (m and degrees, each axis)
    replace the covariance on axes where it is unknown (see `covariance_flaw`). Raises
    `MessageError` with reason ``frame``, ``stamp``, ``position``, ``quaternion``, ``covariance`` or
    ``attitude``.
    """
    check_frame(msg.header.frame_id, map_frame, "pose")
    position = _position(msg.pose.pose.position, "pose position")
    rotation = _rotation(msg.pose.pose.orientation, "pose orientation")
    covariance, unknown, _ = _covariance(_content(msg.pose.covariance))
    if unknown.any():
        sigmas = np.repeat([unknown_position_sigma, np.deg2rad(unknown_attitude_sigma_deg)], 3)
        covariance = covariance + np.diag(np.where(unknown, sigmas, 0.0) ** 2)
    return Pose(stamp_ns(msg.header), position, rotation, covariance)


def covariance_flaw(msg: Any) -> str:
    """Return ``unknown`` if a variance of a pose is not a number, negative or above
    `UNKNOWN_VARIANCES`, or all others of the position, or of the attitude, are zero; ``invalid`` if
    the matrix is not a covariance, so that only its variances are used; else an empty string."""
    _, unknown, valid = _covariance(_content(msg.pose.covariance))
    return "unknown" if unknown.any() else "" if valid else "invalid"


def mount_from_message(msg: Any, what: str = "gimbal") -> Pose:
    """Return the pose of the lidar in body axes from a ``geometry_msgs/TransformStamped`` from body
    to lidar; the covariance is zero. ``what``: name in error messages. Raises `MessageError` with
    reason ``stamp``, ``position`` or ``quaternion``."""
    position = _position(msg.transform.translation, f"{what} translation")
    rotation = _rotation(msg.transform.rotation, f"{what} rotation")
    return Pose(stamp_ns(msg.header), position, rotation, np.zeros((6, 6)))


def check_frame(frame: str, expected: str, what: str) -> None:
    """Raise `MessageError` with reason ``frame`` if two names, without leading slash, differ."""
    if str(frame).lstrip("/") != expected.lstrip("/"):
        text = f"{what} is in frame '{one_line(frame, 80)}', expected '{expected}'"
        text += " (parameter frames.map)"
        raise MessageError("frame", text)


def _content(covariance: Any) -> bytes:
    return np.asarray(covariance, dtype=np.float64).tobytes()


@lru_cache(maxsize=8)  # most publishers repeat theirs, at hundreds of poses per second
def _covariance(content: bytes) -> tuple[Array, Mask, bool]:
    """Parse a covariance of 36 float64, row by row.

    Returns the covariance (6, 6), read-only and zero along unknown axes; which axes are unknown,
    (6,); and whether the matrix is a covariance, else only its diagonal is used. This is tested
    after scaling to unit diagonal, because metres and radians differ by orders of magnitude.
    Rounding is corrected, and an empty triangle is mirrored. Raises as `pose_from_message`.
    """
    entries = np.frombuffer(content)
    if entries.size != 36:
        text = f"pose covariance has {entries.size} entries; 36 are needed"
        raise MessageError("covariance", text)
    matrix = entries.reshape(6, 6)
    variances = matrix.diagonal()
    unknown = ~((variances >= 0.0) & (variances <= UNKNOWN_VARIANCES))  # also if not a number
    empty = (unknown | (variances == 0.0)).reshape(2, 3).all(axis=1)
    unknown |= np.repeat(empty, 3)
    omitted = unknown | unknown[:, None] | np.isnan(matrix)
    matrix = np.where(omitted, 0.0, matrix)
    upper, lower = np.triu(matrix, 1), np.tril(matrix, -1)
    if upper.any() != lower.any():
        matrix = matrix + (upper + lower).T
    sigmas = np.sqrt(matrix.diagonal())
    scale = np.where(sigmas > 0.0, sigmas, 1.0)
    with np.errstate(all="ignore"):
        scaled = matrix / scale[:, None] / scale
        valid = bool(np.abs(scaled - scaled.T).max() <= COVARIANCE_TOLERANCE)
    scaled = 0.5 * (scaled + scaled.T) if valid else np.diag(scaled.diagonal())
    eigenvalues, vectors = np.linalg.eigh(scaled)
    if eigenvalues[0] < -COVARIANCE_TOLERANCE:
        valid, scaled = False, np.diag(scaled.diagonal())
    elif eigenvalues[0] < 0.0:
        scaled = (vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T
    covariance: Array = scaled * np.outer(scale, scale)
    largest = float(covariance.diagonal()[3:].max())
    if largest > MAX_ATTITUDE_VARIANCE:
        text = f"pose attitude has a variance of {largest:.3g} rad^2, too large to place points;"
        text += " send zeros if it is unknown (pose.unknown_attitude_sigma_deg)"
        raise MessageError("attitude", text)
    covariance.flags.writeable = False
    return covariance, unknown, valid


def _position(point: Any, what: str) -> Array:
    values = (float(point.x), float(point.y), float(point.z))
    if not all(abs(value) <= MAX_POSITION for value in values):  # also when one is not a number
        text = f"{what} ({point.x}, {point.y}, {point.z}) is not finite or not plausible"
        raise MessageError("position", text)
    return np.array(values)


def _rotation(quaternion: Any, what: str) -> Array:
    q = quaternion
    xyzw = (float(q.x), float(q.y), float(q.z), float(q.w))
    length = math.hypot(*xyzw)
    if not abs(length - 1.0) <= UNIT_TOLERANCE:  # also when it is not a number
        text = f"{what} ({q.x}, {q.y}, {q.z}, {q.w}) is not a unit quaternion: length {length:.4g}"
        raise MessageError("quaternion", text)
    return rotation_from_quaternion(xyzw)
