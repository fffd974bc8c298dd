# SPDX-License-Identifier: Apache-2.0
"""Conversion of the autopilot's frames (NED, FRD) to ROS's (ENU, FLU), and of its clock."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

import numpy as np

from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.core.geometry.rotations import (
    quaternion_from_rotation,
    rotation_from_quaternion,
)

R_ENU_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""Rotation between NED and ENU, in both directions."""
FRD_TO_FLU = np.array([1.0, -1.0, -1.0])
"""Signs of the axes between FRD and FLU, in both directions."""

UPPER = np.triu_indices(6)


class Nav(NamedTuple):
    """Pose and velocity of the body in the map frame (ENU from the autopilot's local origin)."""

    stamp_ns: int  # by this computer's clock
    position: Array  # (3,) m
    quaternion: Array  # (4,) x, y, z, w; rotation from FLU body axes to the map
    velocity: Array  # (3,) in the map, m/s
    covariance: Array | None  # (6, 6) of position and of rotation about the map axes, m and rad
    own_ns: int  # stamp by the autopilot's clock


def enu(north_east_down: Array) -> Array:
    """Convert a vector (3,) from NED to ENU, or back."""
    return R_ENU_NED @ north_east_down


def attitude(q_wxyz: Array) -> Array:
    """Convert a rotation FRD to NED (w, x, y, z) to the rotation FLU to ENU (x, y, z, w)."""
    w, x, y, z = q_wxyz
    return quaternion_from_rotation(R_ENU_NED @ rotation_from_quaternion((x, y, z, w)) * FRD_TO_FLU)


def body_frd(vector_enu: Array, quaternion: Array) -> Array:
    """Rotate a vector (3,) from ENU to FRD body axes; ``quaternion``: FLU to ENU."""
    return FRD_TO_FLU * (rotation_from_quaternion(quaternion).T @ vector_enu)


def covariance_enu(upper: Array, quaternion: Array) -> Array | None:
    """Convert the pose covariance of MAVLink's ODOMETRY to ROS's (6, 6); None if it is unknown.

    MAVLink's position error is in NED and its attitude error in FRD body axes: with
    T = diag(R_enu_ned, R_enu_frd) the result is T C T^T. ``upper``: upper triangle of C (21,), row
    by row; NaN in the first element, or infinity in any, means unknown. ``quaternion``: FLU to ENU.
    """
    values = np.asarray(upper, dtype=np.float64)
    if not np.isfinite(values[0]) or np.isinf(values).any():
        return None
    full = np.zeros((6, 6))
    full[UPPER] = np.where(np.isnan(values), 0.0, values)
    full = full + np.triu(full, 1).T
    if not full.diagonal().all():
        return None
    turn = np.zeros((6, 6))
    turn[:3, :3], turn[3:, 3:] = R_ENU_NED, rotation_from_quaternion(quaternion) * FRD_TO_FLU
    return turn @ full @ turn.T


class RemoteClock:
    """Offset of an autopilot's clock, estimated from TIMESYNC exchanges.

    The estimate is that of the fastest recent exchange; its error is at most half the round trip.
    """

    KEPT = 40
    """Number of recent exchanges."""
    STEP_NS = 50_000_000
    """Largest time step of a simulator's clock."""

    def __init__(self) -> None:
        self._exchanges: deque[tuple[int, int]] = deque(maxlen=self.KEPT)

    def add(self, sent_ns: int, remote_ns: int, received_ns: int) -> None:
        """Add an exchange: sent and received by this clock, stamped by the remote one between."""
        round_trip = received_ns - sent_ns
        if round_trip < 0:  # this clock was set back
            self._exchanges.clear()
            return
        self._exchanges.append((round_trip, sent_ns + round_trip // 2 - remote_ns))
        offset = self._best[1]
        last = self._exchanges[-1]
        if abs(last[1] - offset) > round_trip + self.STEP_NS:  # one of the clocks was set
            self._exchanges.clear()
            self._exchanges.append(last)

    @property
    def offset_ns(self) -> int | None:
        """This clock minus the remote one; None before the first exchange."""
        return self._best[1] if self._exchanges else None

    @property
    def uncertainty_ns(self) -> int | None:
        """Half the round trip of the fastest exchange; None before the first."""
        return self._best[0] // 2 if self._exchanges else None

    @property
    def _best(self) -> tuple[int, int]:
        """Round trip and offset of the fastest exchange; among equal ones the largest offset."""
        return min(self._exchanges, key=lambda exchange: (exchange[0], -exchange[1]))


MAX_GAP_S = 3.0
"""Longest time between poses over which velocity is integrated: without new set-points the vehicle
moves for two seconds."""


class JumpDetector:
    """Detect position jumps that the velocity does not explain, such as a position reset."""

    def __init__(self) -> None:
        self._last: Nav | None = None

    def jump(self, nav: Nav) -> float:
        """Return the distance of this position from the range that the velocities of the last and
        this pose explain on each axis, m; 0 for the first pose."""
        last, self._last = self._last, nav
        if last is None:
            return 0.0
        # The autopilot's clock is free of offset corrections. It goes back after a restart.
        dt = min(max(1e-9 * (nav.own_ns - last.own_ns), 0.0), MAX_GAP_S)
        ways = dt * np.array([last.velocity, nav.velocity, np.zeros(3)])
        moved = nav.position - last.position
        return float(np.linalg.norm(moved - np.clip(moved, ways.min(axis=0), ways.max(axis=0))))
