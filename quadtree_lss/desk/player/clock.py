# SPDX-License-Identifier: Apache-2.0
"""The time of a bag that is played into nodes."""

from __future__ import annotations

import time

from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from quadtree_lss.onboard.nodes.qos import stream
from quadtree_lss.onboard.nodes.ros_messages import time_message

SECOND_NS = 1_000_000_000
PERIOD_S = 0.02
"""Longest interval between two messages on ``/clock``, s of the steady clock."""


class PlayTime:
    """Wait for the time of each message, and publish the bag's time on ``/clock``.

    ``node`` owns the publisher; ``rate`` is in bag seconds per second. The time starts at the first
    message that is waited for.
    """

    def __init__(self, node: Node, rate: float) -> None:
        self._ns_per_s = rate * SECOND_NS
        self._clock = node.create_publisher(Clock, "/clock", stream(10, reliable=True))
        self._began: tuple[int, float] | None = None  # time of the bag, ns; of the steady clock, s

    def wait_until(self, bag_ns: int) -> None:
        """Return when it is time for the message that the bag received at ``bag_ns``."""
        began_ns, began_s = self._began = self._began or (bag_ns, time.monotonic())
        while True:
            now_ns = began_ns + round((time.monotonic() - began_s) * self._ns_per_s)
            self._clock.publish(Clock(clock=time_message(min(now_ns, bag_ns))))
            if now_ns >= bag_ns:
                return
            time.sleep(min((bag_ns - now_ns) / self._ns_per_s, PERIOD_S))
