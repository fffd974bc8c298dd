# SPDX-License-Identifier: Apache-2.0
"""North, east, down to east, north, up; and an autopilot's clock to this computer's."""

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
"""Takes north, east, down to east, north, up, and back."""
FRD_TO_FLU = np.array([1.0, -1.0, -1.0])
"""Takes forward, right, down to forward, left, up, and back."""

UPPER = np.triu_indices(6)


class Nav(NamedTuple):
    """The body in the map, whose axes are east, north, up from the autopilot's local origin.

    Attributes:
        stamp_ns: By this computer's clock.
        position: (3,) m.
        quaternion: (4,) x, y, z, w; takes forward, left, up to the map's axes.
        velocity: (3,) of the map's axes, m/s.
        covariance: (6, 6) of place and of the rotation about the map's fixed axes, m and rad;
            None where the autopilot does not say.
        own_ns: The stamp by the autopilot's clock.
    """

    stamp_ns: int
    position: Array
    quaternion: Array
    velocity: Array
    covariance: Array | None
    own_ns: int


def enu(north_east_down: Array) -> Array:
    """(3,) in the other axes; its own inverse."""
    return R_ENU_NED @ north_east_down


def attitude(q_wxyz: Array) -> Array:
    """(4,) x, y, z, w of FLU axes to ENU, from w, x, y, z of FRD axes to NED."""
    w, x, y, z = q_wxyz
    return quaternion_from_rotation(R_ENU_NED @ rotation_from_quaternion((x, y, z, w)) * FRD_TO_FLU)


def body_frd(vector_enu: Array, quaternion: Array) -> Array:
    """(3,) along forward, right, down of a body whose FLU axes the quaternion takes to ENU."""
    return FRD_TO_FLU * (rotation_from_quaternion(quaternion).T @ vector_enu)


def covariance_enu(upper: Array, quaternion: Array) -> Array | None:
    """(6, 6) as ROS has it, from the 21 numbers of MAVLink's ODOMETRY; None if it does not say.

    Of the latter place is along north, east, down and the attitude's error about the body's
    forward, right, down: with T = diag(R_enu_ned, R_enu_frd) it becomes T C T^T. ``upper``: the
    upper triangle, row by row; a first number that is NaN, and any infinite one, says unknown.
    ``quaternion``: FLU to ENU.
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
    """An autopilot's clock, by exchanges of TIMESYNC: what to add to it.

    Of the last exchanges the quickest counts: half its way is all that it can be wrong by, and a
    loaded computer lets the others wait.
    """

    KEPT = 40
    STEP_NS = 50_000_000
    """Time that comes in steps, as a simulator's, differs by so much."""

    def __init__(self) -> None:
        self._exchanges: deque[tuple[int, int]] = deque(maxlen=self.KEPT)

    def add(self, sent_ns: int, remote_ns: int, received_ns: int) -> None:
        """An answer: sent and received by this clock, stamped by the other in between."""
        way = received_ns - sent_ns
        if way < 0:  # this clock was set
            self._exchanges.clear()
            return
        self._exchanges.append((way, sent_ns + way // 2 - remote_ns))
        offset = self._best[1]
        last = self._exchanges[-1]
        if abs(last[1] - offset) > way + self.STEP_NS:  # the other was started anew, or this set
            self._exchanges.clear()
            self._exchanges.append(last)

    @property
    def offset_ns(self) -> int | None:
        """This clock less the other; None before the first exchange."""
        return self._best[1] if self._exchanges else None

    @property
    def uncertainty_ns(self) -> int | None:
        """Half the quickest exchange."""
        return self._best[0] // 2 if self._exchanges else None

    @property
    def _best(self) -> tuple[int, int]:
        """The quickest; of equal ones, as where time comes in steps, the one that waited least."""
        return min(self._exchanges, key=lambda one: (one[0], -one[1]))


EXPLAINS_S = 3.0
"""Velocity explains no more of a gap: without new set-points the vehicle flies for two seconds."""


class JumpDetector:
    """Finds motion that navigation's own velocity does not explain, as of a position reset."""

    def __init__(self) -> None:
        self._last: Nav | None = None

    def jump(self, nav: Nav) -> float:
        """Return how far this place is from all that the velocities before and after explain since
        the last pose, along each axis, m; 0 for the first pose."""
        last, self._last = self._last, nav
        if last is None:
            return 0.0
        # By its own clock: corrections of its offset are no motion. It goes back if it restarts.
        dt = min(max(1e-9 * (nav.own_ns - last.own_ns), 0.0), EXPLAINS_S)
        ways = dt * np.array([last.velocity, nav.velocity, np.zeros(3)])
        moved = nav.position - last.position
        return float(np.linalg.norm(moved - np.clip(moved, ways.min(axis=0), ways.max(axis=0))))
