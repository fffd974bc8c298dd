# SPDX-License-Identifier: Apache-2.0
"""Poses as they arrive, validated, to ``core.sensing.lidar.Pose``; duck-typed like the clouds."""

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
"""Metres; positions beyond are absurd."""

MAX_ATTITUDE_VARIANCE = 0.25
"""rad^2; an attitude known to no better than 0.5 rad places no point."""

UNKNOWN_VARIANCES = np.repeat([300.0**2, (2.0 * np.pi) ** 2], 3)
"""m^2, rad^2; more says "unknown", as drivers do with 1e6 on axes that they do not estimate."""

UNIT_TOLERANCE = 0.01
"""A quaternion's length may differ from one by this; it is normalised."""

COVARIANCE_TOLERANCE = 1e-5
"""Relative asymmetry and negative eigenvalue that count as rounding, of single precision, and are
corrected."""


def pose_from_message(
    msg: Any,
    map_frame: str,
    *,
    unknown_position_sigma: float = 0.1,
    unknown_attitude_sigma_deg: float = 0.05,
) -> Pose:
    """Pose of the lidar (or body) in the map frame.

    Where the covariance says "unknown" (see `covariance_flaw`), the two sigmas (m and degrees,
    each axis) take its place. ``msg`` is like ``geometry_msgs/PoseWithCovarianceStamped`` or
    ``nav_msgs/Odometry``, of which the velocity is not used; its header's frame must be
    ``map_frame``, a leading slash aside; its covariance is of (x, y, z, rotation about that frame's
    fixed axes), m and rad. Raises `MessageError`: reason ``frame``, ``stamp``, ``position``,
    ``quaternion``, ``covariance`` or ``attitude``.
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
    """``unknown`` if a variance of a pose is: it is not a number, negative or above
    `UNKNOWN_VARIANCES`, or all of position, or of attitude, are zero beside; ``invalid`` if the
    matrix is no covariance, so that only its variances count; else empty. Raises `MessageError` as
    `pose_from_message`."""
    _, unknown, sound = _covariance(_content(msg.pose.covariance))
    return "unknown" if unknown.any() else "" if sound else "invalid"


def mount_from_message(msg: Any, what: str = "gimbal") -> Pose:
    """Pose of the lidar in body axes from a ``geometry_msgs/TransformStamped`` body to lidar.

    The transform is ROS's: header frame the body, child frame the lidar, translation the lidar's
    origin in body axes, rotation taking lidar to body axes. The covariance is zero. Raises
    `MessageError`: with reason ``stamp``, ``position`` or ``quaternion``.
    """
    position = _position(msg.transform.translation, f"{what} translation")
    rotation = _rotation(msg.transform.rotation, f"{what} rotation")
    return Pose(stamp_ns(msg.header), position, rotation, np.zeros((6, 6)))


def check_frame(frame: str, expected: str, what: str) -> None:
    """Raises MessageError ``frame`` unless both names are the same frame."""
    if str(frame).lstrip("/") != expected.lstrip("/"):
        text = f"{what} is in frame '{one_line(frame, 80)}', expected '{expected}'"
        text += " (parameter frames.map)"
        raise MessageError("frame", text)


def _content(covariance: Any) -> bytes:
    return np.asarray(covariance, dtype=np.float64).tobytes()


@lru_cache(maxsize=8)  # most publishers repeat theirs, and poses come at hundreds a second
def _covariance(content: bytes) -> tuple[Array, Mask, bool]:
    """A covariance (6, 6) of 36 float64 row by row, read-only, zero along axes that are unknown;
    (6,) which are; and whether the matrix is one.

    Rounding is corrected. Of a matrix with one empty triangle the other counts, of one that is not
    symmetric or has a negative eigenvalue only the diagonal. This is judged after scaling to unit
    diagonal, since metres and radians differ by orders of magnitude. Raises `MessageError`:
    ``covariance`` if it is of another length; ``attitude`` if that is too uncertain to place a
    point.
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
    left_out = unknown | unknown[:, None] | np.isnan(matrix)
    matrix = np.where(left_out, 0.0, matrix)
    upper, lower = np.triu(matrix, 1), np.tril(matrix, -1)
    if upper.any() != lower.any():
        matrix = matrix + (upper + lower).T
    sigmas = np.sqrt(matrix.diagonal())
    scale = np.where(sigmas > 0.0, sigmas, 1.0)
    with np.errstate(all="ignore"):
        scaled = matrix / scale[:, None] / scale
        sound = bool(np.abs(scaled - scaled.T).max() <= COVARIANCE_TOLERANCE)
    scaled = 0.5 * (scaled + scaled.T) if sound else np.diag(scaled.diagonal())
    eigenvalues, vectors = np.linalg.eigh(scaled)
    if eigenvalues[0] < -COVARIANCE_TOLERANCE:
        sound, scaled = False, np.diag(scaled.diagonal())
    elif eigenvalues[0] < 0.0:
        scaled = (vectors * np.maximum(eigenvalues, 0.0)) @ vectors.T
    covariance: Array = scaled * np.outer(scale, scale)
    widest = float(covariance.diagonal()[3:].max())
    if widest > MAX_ATTITUDE_VARIANCE:
        text = f"pose attitude has a variance of {widest:.3g} rad^2, so nothing is known of it"
        text += "; zeros say unknown (pose.unknown_attitude_sigma_deg)"
        raise MessageError("attitude", text)
    covariance.flags.writeable = False
    return covariance, unknown, sound


def _position(point: Any, what: str) -> Array:
    values = (float(point.x), float(point.y), float(point.z))
    if not all(abs(value) <= MAX_POSITION for value in values):  # also when one is not a number
        text = f"{what} ({point.x}, {point.y}, {point.z}) is not finite or absurd"
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
