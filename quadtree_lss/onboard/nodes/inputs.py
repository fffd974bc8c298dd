# SPDX-License-Identifier: Apache-2.0
"""How mapping_node listens: types that may be missing, and subscriptions that do not wake it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup

from quadtree_lss.onboard.config.settings import ConfigError


def transforms_type() -> Any:
    """``tf2_msgs/TFMessage``, which comes with ROS, not with its wheels.

    Raises:
        ConfigError: it cannot be imported.
    """
    try:
        from tf2_msgs.msg import TFMessage
    except ImportError:
        msg = "mount.tf needs tf2_msgs (apt install ros-jazzy-tf2-msgs): set mount.x ... instead"
        raise ConfigError(msg) from None
    return TFMessage


class WhenWanted(CallbackGroup):
    """Subscriptions that wake the node only while their messages are wanted.

    A scan takes along what arrived before it, so only one that waits needs the next pose at once;
    each wake-up costs as much as taking several messages.

    Attributes:
        wanted: True while they are.
    """

    def __init__(self, wanted: Callable[[], bool]) -> None:
        super().__init__()
        self.wanted = wanted

    def can_execute(self, entity: Any) -> bool:
        """Asked by the executor before it waits and after it woke."""
        return self.wanted()

    def beginning_execution(self, entity: Any) -> bool:
        """Nothing to keep account of in a single thread."""
        return True

    def ending_execution(self, entity: Any) -> None:
        """Nothing either."""
