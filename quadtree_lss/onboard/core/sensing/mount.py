# SPDX-License-Identifier: Apache-2.0
"""Where the lidar sits on the body, when poses are those of the body."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from quadtree_lss.onboard.config.settings import MountConfig
from quadtree_lss.onboard.core.geometry.rotations import exp, skew
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.pose_buffer import PoseBuffer

#: What takes a cloud's axes to those of the lidar's pose, by the choices of ``mount.axes``.
#: FLU: x forward, y left, z up (REP 103); optical: z forward, x right, y down (Eq. 14).
OPTICAL_FROM_FLU = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
AXES = {"same": np.eye(3), "flu_to_optical": OPTICAL_FROM_FLU, "optical_to_flu": OPTICAL_FROM_FLU.T}


class MountedPoses:
    """Lidar poses from those of the body (``rotation_map_lidar`` is then map from body) and the
    lidar's mount on it: its pose in body axes, or a buffer of such poses (a gimbal); None until it
    is known. ``gimbal_topic`` and ``explain_missing`` are for texts: where it comes from, why it is not
    known."""

    def __init__(
        self,
        body: PoseBuffer,
        mount: Pose | PoseBuffer | None,
        gimbal_topic: str = "lidar/gimbal",
        explain_missing: Callable[[], str] = str,
    ) -> None:
        self.body = body
        self.mount = mount
        self.gimbal_topic = gimbal_topic
        self.explain_missing = explain_missing

    @property
    def jumps(self) -> int:
        """Backward jumps of either."""
        return self.body.jumps + (self.mount.jumps if isinstance(self.mount, PoseBuffer) else 0)

    def clear(self) -> None:
        """Forgets the poses of the body and of a gimbal."""
        self.body.clear()
        if isinstance(self.mount, PoseBuffer):
            self.mount.clear()

    @property
    def range_ns(self) -> tuple[int, int] | None:
        """Oldest and newest stamp for which both may have an answer."""
        body = self.body.range_ns
        if body is None or not isinstance(self.mount, PoseBuffer):
            return body
        mount = self.mount.range_ns
        return None if mount is None else (max(body[0], mount[0]), min(body[1], mount[1]))

    def pose_at(self, stamp_ns: int) -> Pose | None:
        """Pose of the lidar at the stamp, None unless both body and mount are known then."""
        body = self.body.pose_at(stamp_ns)
        mount = self.mount.pose_at(stamp_ns) if isinstance(self.mount, PoseBuffer) else self.mount
        return None if body is None or mount is None else mounted(body, mount)

    def covers(self, stamp_ns: int) -> bool:
        """True if ``at`` has an answer."""
        if self.mount is None or not self.body.covers(stamp_ns):
            return False
        return isinstance(self.mount, Pose) or self.mount.covers(stamp_ns)

    def stamps_between(self, first_ns: int, last_ns: int) -> list[int]:
        """Stamps of the poses of either that lie between, both ends excluded."""
        stamps = self.body.stamps_between(first_ns, last_ns)
        if isinstance(self.mount, PoseBuffer):
            stamps = sorted({*stamps, *self.mount.stamps_between(first_ns, last_ns)})
        return stamps

    def drop_reason(self, stamp_ns: int) -> str | None:
        """As of the body; of the mount with ``gimbal_`` in front."""
        reason = self.body.drop_reason(stamp_ns)
        if reason is None and isinstance(self.mount, PoseBuffer):
            of_mount = self.mount.drop_reason(stamp_ns)
            reason = None if of_mount is None else f"gimbal_{of_mount}"
        return reason

    def timeout_reason(self, stamp_ns: int) -> str:
        """``no_pose`` of the body, ``no_mount`` or ``gimbal_no_pose``."""
        if self.body.covers(stamp_ns) and self.mount is None:
            return "no_mount"
        if self.body.covers(stamp_ns) and isinstance(self.mount, PoseBuffer):
            return f"gimbal_{self.mount.timeout_reason(stamp_ns)}"
        return self.body.timeout_reason(stamp_ns)

    def explain(self, stamp_ns: int, topic: str) -> str:
        """As of the body, unless it is the mount or the gimbal that is missing."""
        if self.body.covers(stamp_ns) and self.mount is None:
            return self.explain_missing()
        if self.body.covers(stamp_ns) and isinstance(self.mount, PoseBuffer):
            return self.mount.explain(stamp_ns, self.gimbal_topic)
        return self.body.explain(stamp_ns, topic)


#: What a scan asks for its pose.
PoseSource: TypeAlias = PoseBuffer | MountedPoses


def mounted(body: Pose, mount: Pose) -> Pose:
    """Pose of the lidar from that of the body and the lidar's exact pose in body axes.

    With the arm a = R_map_body t, an error (dm, dw) of the body's pose about fixed axes moves the
    lidar by dm + dw x a and turns it by dw: the covariance is G Sigma G^T, G = [I, -[a]_x; 0, I].
    """
    arm = body.rotation_map_lidar @ mount.position
    moved = np.eye(6)
    moved[:3, 3:] = -skew(arm)
    covariance = moved @ body.covariance @ moved.T
    return Pose(
        body.stamp_ns,
        body.position + arm,
        body.rotation_map_lidar @ mount.rotation_map_lidar,
        0.5 * (covariance + covariance.T),
    )


def cloud_rotation(config: MountConfig) -> NDArray[np.float64]:
    """(3, 3) takes the cloud's axes to the lidar's, as which pose and mount have them."""
    return AXES[config.axes]


def fixed_mount(config: MountConfig) -> Pose | None:
    """Pose of the cloud's axes in body axes from the parameters; None if poses are their own."""
    if config == MountConfig(source=config.source):
        return None
    roll, pitch, yaw = np.radians([config.roll_deg, config.pitch_deg, config.yaw_deg])
    rotation = exp([0.0, 0.0, yaw]) @ exp([0.0, pitch, 0.0]) @ exp([roll, 0.0, 0.0])
    place = np.array([config.x, config.y, config.z])
    return Pose(0, place, rotation @ cloud_rotation(config), np.zeros((6, 6)))
