# SPDX-License-Identifier: Apache-2.0
"""Pose of the lidar on the body, from parameters, ``lidar/gimbal`` or ``/tf_static``."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import AXES, fixed_mount
from quadtree_lss.onboard.core.sensing.transforms import FixedTransforms
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.poses import mount_from_message

MAX_LISTED_FRAMES = 50
"""Limit of the frames listed in a warning."""


class Extrinsics:
    """Frames of body and scans, and with ``mount.source: tf`` the transform between them."""

    def __init__(self, config: Config) -> None:
        self.tf = config.mount.source == "tf"
        self._turn = AXES[config.mount.axes]
        self._fixed = None if self.tf else fixed_mount(config.mount)
        self._tree = FixedTransforms()
        self._body = config.frames.body.lstrip("/")
        self._lidar = ""
        self._found: Pose | None = None

    @property
    def mount(self) -> Pose | None:
        """Pose of the cloud's axes in body axes; None if unknown or the identity."""
        return self._found if self.tf else self._fixed

    def turned(self, lidar: Pose) -> Pose:
        """Convert a pose of the lidar to the pose of the cloud's axes (``mount.axes``)."""
        return replace(lidar, rotation_map_lidar=lidar.rotation_map_lidar @ self._turn)

    def check_body(self, frame: str) -> None:
        """Compare an odometry's child frame with ``frames.body``, or with the first one received.
        Raises `MessageError` with reason ``child_frame`` if they differ."""
        frame = str(frame).lstrip("/")
        if not self._body and frame:
            self._body = frame
            self._find_mount()
        if frame != self._body:
            text = f"odometry is of '{_shown(frame)}', expected '{_shown(self._body)}'"
            text += " (parameter frames.body)"
            raise MessageError("child_frame", text)

    def check_lidar(self, frame: str) -> None:
        """Compare a cloud's frame with the first one received, only with ``mount.source: tf``.
        Raises `MessageError` with reason ``frame`` if they differ."""
        if not self.tf:
            return
        frame = str(frame).lstrip("/")
        if frame == self._lidar:
            return
        if self._lidar:
            earlier = _shown(self._lidar)
            text = f"cloud is in frame '{_shown(frame)}', the earlier ones in '{earlier}'"
            raise MessageError("frame", text)
        self._lidar = frame
        self._find_mount()

    def on_transforms(self, msg: Any) -> None:
        """Use a ``tf2_msgs/TFMessage`` of ``/tf_static``. Raises as `add_transforms`."""
        try:
            add_transforms(self._tree, msg)
        finally:
            self._find_mount()

    def lack(self) -> str:
        """Return why the mount is not known yet."""
        if not self._body:
            return "the body's frame is not known (frames.body, or the child frame of an odometry)"
        received = ", ".join(map(_shown, self._tree.frames()[:MAX_LISTED_FRAMES])) or "none"
        return (
            f"/tf_static has no chain from '{_shown(self._body)}' to '{_shown(self._lidar)}'"
            f" (mount.source tf); frames received: {received}"
        )

    def _find_mount(self) -> None:
        if self._body and self._lidar:
            found = self._tree.relative_pose(self._body, self._lidar)
            if found is not None:
                self._found = self.turned(found)


def add_transforms(tree: FixedTransforms, msg: Any) -> None:
    """Add the transforms of a ``tf2_msgs/TFMessage`` to a tree. Raises `MessageError` for the first
    unusable one, with reason ``stamp``, ``position`` or ``quaternion``; the others are added."""
    first_error: MessageError | None = None
    for item in msg.transforms:
        try:
            transform = mount_from_message(item, "transform")
        except MessageError as error:
            first_error = first_error or error
        else:
            tree.add(item.header.frame_id, item.child_frame_id, transform)
    if first_error is not None:
        raise first_error


def _shown(frame: str) -> str:
    return one_line(frame, 80)
