# SPDX-License-Identifier: Apache-2.0
"""Lidar poses from poses of the body and the mount of the lidar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from quadtree_lss.onboard.config.settings import MountConfig
from quadtree_lss.onboard.core.geometry.rotations import exp, skew
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.pose_buffer import PoseBuffer

#: Rotation of the cloud's axes to those of the lidar's pose for each value of ``mount.axes``.
#: FLU: x forward, y left, z up (REP 103); optical: z forward, x right, y down (Eq. 14).
OPTICAL_FROM_FLU = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
AXES = {"same": np.eye(3), "flu_to_optical": OPTICAL_FROM_FLU, "optical_to_flu": OPTICAL_FROM_FLU.T}


@dataclass
class MountedPoses:
    """Lidar poses from body poses and the mount, with the interface of `PoseBuffer`.

    Attributes:
        body: Poses of the body; their ``rotation_map_lidar`` is map from body.
        mount: Pose of the lidar in body axes, or a buffer of such poses (gimbal); None until it is
            known.
        gimbal_topic, explain_missing: For messages: topic of the gimbal, and a function that
            returns why the mount is not known.
    """

    body: PoseBuffer
    mount: Pose | PoseBuffer | None
    gimbal_topic: str = "lidar/gimbal"
    explain_missing: Callable[[], str] = str

    @property
    def _buffers(self) -> list[PoseBuffer]:
        """Poses of the body and, with a gimbal, of the lidar on it."""
        return [self.body, self.mount] if isinstance(self.mount, PoseBuffer) else [self.body]

    @property
    def jumps(self) -> int:
        """Backward jumps of body and gimbal."""
        return sum(buffer.jumps for buffer in self._buffers)

    def clear(self) -> None:
        """Forget the poses of body and gimbal."""
        for buffer in self._buffers:
            buffer.clear()

    @property
    def range_ns(self) -> tuple[int, int] | None:
        """Oldest and newest stamp that both body and gimbal may cover."""
        ranges = [buffer.range_ns for buffer in self._buffers]
        known = [held for held in ranges if held is not None]
        if len(known) < len(ranges):
            return None
        return max(oldest for oldest, _ in known), min(newest for _, newest in known)

    def pose_at(self, stamp_ns: int) -> Pose | None:
        """Return the lidar's pose at a stamp, None unless body and mount are known there."""
        body = self.body.pose_at(stamp_ns)
        mount = self.mount.pose_at(stamp_ns) if isinstance(self.mount, PoseBuffer) else self.mount
        return None if body is None or mount is None else mounted(body, mount)

    def covers(self, stamp_ns: int) -> bool:
        """Return whether `pose_at` returns a pose."""
        return self.mount is not None and all(b.covers(stamp_ns) for b in self._buffers)

    def stamps_between(self, first_ns: int, last_ns: int) -> list[int]:
        """Return the stamps of body and gimbal poses between two stamps, both excluded."""
        return sorted({s for b in self._buffers for s in b.stamps_between(first_ns, last_ns)})

    def drop_reason(self, stamp_ns: int) -> str | None:
        """Return as `PoseBuffer.drop_reason`; of a gimbal with the prefix ``gimbal_``."""
        reason = self.body.drop_reason(stamp_ns)
        if reason is None and isinstance(self.mount, PoseBuffer):
            gimbal_reason = self.mount.drop_reason(stamp_ns)
            reason = gimbal_reason and f"gimbal_{gimbal_reason}"
        return reason

    def timeout_reason(self, stamp_ns: int) -> str:
        """Return ``no_pose``, ``no_mount`` or ``gimbal_no_pose``."""
        if isinstance(self.mount, Pose) or not self.body.covers(stamp_ns):
            return "no_pose"
        return "no_mount" if self.mount is None else "gimbal_no_pose"

    def explain(self, stamp_ns: int, topic: str) -> str:
        """Return as `PoseBuffer.explain` for what is missing: body, mount or gimbal."""
        if isinstance(self.mount, Pose) or not self.body.covers(stamp_ns):
            return self.body.explain(stamp_ns, topic)
        if self.mount is None:
            return self.explain_missing()
        return self.mount.explain(stamp_ns, self.gimbal_topic)


PoseSource: TypeAlias = PoseBuffer | MountedPoses


def mounted(body: Pose, mount: Pose) -> Pose:
    """Compute the pose of the lidar from that of the body and the exact mount in body axes.

    With the arm a = R_map_body t, an error (dm, dw) of the body's pose about fixed axes moves the
    lidar by dm + dw x a and rotates it by dw: the covariance is G Sigma G^T, G = [I, -[a]_x; 0, I].
    """
    arm = body.rotation_map_lidar @ mount.position
    jacobian = np.eye(6)
    jacobian[:3, 3:] = -skew(arm)
    covariance = jacobian @ body.covariance @ jacobian.T
    return Pose(
        body.stamp_ns,
        body.position + arm,
        body.rotation_map_lidar @ mount.rotation_map_lidar,
        0.5 * (covariance + covariance.T),
    )


def fixed_mount(config: MountConfig) -> Pose | None:
    """Return the configured pose of the cloud's axes in body axes, None without a mount."""
    if config == MountConfig(source=config.source):
        return None
    roll, pitch, yaw = np.radians([config.roll_deg, config.pitch_deg, config.yaw_deg])
    rotation = exp([0.0, 0.0, yaw]) @ exp([0.0, pitch, 0.0]) @ exp([roll, 0.0, 0.0])
    position = np.array([config.x, config.y, config.z])
    return Pose(0, position, rotation @ AXES[config.axes], np.zeros((6, 6)))
