# SPDX-License-Identifier: Apache-2.0
"""Where frames sit on one another: a tree of fixed transforms, as ``/tf_static`` tells it."""

from __future__ import annotations

import numpy as np

from quadtree_lss.onboard.core.sensing.lidar import Pose

#: Of a vehicle there are tens; whoever sends more is out of order.
MAX_FRAMES = 10_000


class FixedTransforms:
    """Collects fixed transforms; `between` follows them from frame to frame.

    Names with and without a leading slash are the same.
    """

    def __init__(self) -> None:
        self._parent: dict[str, tuple[str, Pose]] = {}

    def add(self, parent: str, child: str, child_in_parent: Pose) -> bool:
        """Take the pose of a frame in its parent, which replaces one told before. Returns whether
        that is anything new; beyond `MAX_FRAMES` nothing is."""
        parent, child = _name(parent), _name(child)
        known = self._parent.get(child)
        if known is not None and known[0] == parent and _same(known[1], child_in_parent):
            return False
        if known is None and len(self._parent) >= MAX_FRAMES:
            return False
        self._parent[child] = (parent, child_in_parent)
        return True

    def relative_pose(self, body: str, lidar: str) -> Pose | None:
        """Pose of the second frame in the first; None if no chain joins them."""
        to_body, to_lidar = self._up(_name(body)), self._up(_name(lidar))
        common = next((frame for frame in to_lidar if frame in to_body), None)
        if common is None:
            return None
        p_body, r_body = to_body[common]
        p_lidar, r_lidar = to_lidar[common]
        place = r_body.T @ (p_lidar - p_body)
        return Pose(0, place, r_body.T @ r_lidar, np.zeros((6, 6)))

    def frames(self) -> list[str]:
        """All names heard of."""
        return sorted(
            {name for child, (parent, _) in self._parent.items() for name in (child, parent)}
        )

    def _up(self, frame: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """A frame's position and rotation in each frame above it, itself first."""
        position, rotation = np.zeros(3), np.eye(3)
        found = {frame: (position, rotation)}
        while frame in self._parent:
            frame, step = self._parent[frame]
            if frame in found:  # a loop
                break
            position = step.position + step.rotation_map_lidar @ position
            rotation = step.rotation_map_lidar @ rotation
            found[frame] = (position, rotation)
        return found


def _name(frame: str) -> str:
    return str(frame).lstrip("/")


def _same(first: Pose, second: Pose) -> bool:
    return np.array_equal(first.position, second.position) and np.array_equal(
        first.rotation_map_lidar, second.rotation_map_lidar
    )
