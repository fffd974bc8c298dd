# SPDX-License-Identifier: Apache-2.0
"""A tree of fixed transforms between frames, as published on ``/tf_static``."""

from __future__ import annotations

import numpy as np

from quadtree_lss.onboard.core.sensing.lidar import Pose

#: Most frames that are stored: a vehicle has tens of them.
MAX_FRAMES = 10_000


class FixedTransforms:
    """Stores fixed transforms, and chains them in `relative_pose`.

    A leading slash of a frame name is ignored.
    """

    def __init__(self) -> None:
        self._parent: dict[str, tuple[str, Pose]] = {}

    def add(self, parent: str, child: str, child_in_parent: Pose) -> bool:
        """Store the pose of a frame in its parent, which replaces an earlier one.

        Return whether anything changed. Beyond `MAX_FRAMES`, new frames are ignored.
        """
        parent, child = _name(parent), _name(child)
        known = self._parent.get(child)
        matrix = child_in_parent.matrix
        if known is not None and known[0] == parent and np.array_equal(known[1].matrix, matrix):
            return False
        if known is None and len(self._parent) >= MAX_FRAMES:
            return False
        self._parent[child] = (parent, child_in_parent)
        return True

    def relative_pose(self, body: str, lidar: str) -> Pose | None:
        """Return the pose of the lidar frame in the body frame, None if they are not connected."""
        to_body = self._poses_in_ancestors(_name(body))
        to_lidar = self._poses_in_ancestors(_name(lidar))
        common = next((frame for frame in to_lidar if frame in to_body), None)
        if common is None:
            return None
        p_body, r_body = to_body[common]
        p_lidar, r_lidar = to_lidar[common]
        position = r_body.T @ (p_lidar - p_body)
        return Pose(0, position, r_body.T @ r_lidar, np.zeros((6, 6)))

    def frames(self) -> list[str]:
        """Return the names of all frames."""
        return sorted(
            {name for child, (parent, _) in self._parent.items() for name in (child, parent)}
        )

    def _poses_in_ancestors(self, frame: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Return position and rotation of a frame in itself and in each of its ancestors."""
        position, rotation = np.zeros(3), np.eye(3)
        found = {frame: (position, rotation)}
        while frame in self._parent:
            frame, pose = self._parent[frame]
            if frame in found:  # a loop
                break
            position = pose.position + pose.rotation_map_lidar @ position
            rotation = pose.rotation_map_lidar @ rotation
            found[frame] = (position, rotation)
        return found


def _name(frame: str) -> str:
    return str(frame).lstrip("/")
