#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Follows the target of ``landing/selected``: what a guidance node does with it, and no more.

The target holds by itself: while landing there is permitted it stays, whatever the ranking does. So
a guidance node flies to the last one, and has none after a message without a place (NaN) or when
``lss_node`` is heard of no more. Run it beside the nodes: ``python3 site_subscriber.py``.
"""

import math
import signal

import rclpy
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from rclpy.duration import Duration
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

LATCHED = {
    "depth": 1,
    "reliability": ReliabilityPolicy.RELIABLE,
    "durability": DurabilityPolicy.TRANSIENT_LOCAL,
}
DEADLINE = Duration(seconds=1.0)  # lss_node says its target again before that


class TargetFollower(Node):
    """Publishes the target to fly to on ``guidance/target``; NaN when there is none."""

    def __init__(self):
        super().__init__("target_follower")
        self._target = None
        self._output = self.create_publisher(PointStamped, "guidance/target", QoSProfile(**LATCHED))
        self.create_subscription(
            PoseWithCovarianceStamped,
            "landing/selected",
            self._on_selected,
            QoSProfile(**LATCHED, deadline=DEADLINE),
            event_callbacks=SubscriptionEventCallbacks(
                deadline=self._on_silence, matched=self._on_publishers
            ),
        )

    def _on_selected(self, message):
        place = message.pose.pose.position
        if math.isnan(place.x):
            self._take(None, message.header, "withdrawn: landing/status tells why")
            return
        sigma = math.sqrt(message.pose.covariance[14])
        self._take(place, message.header, f"height known to {sigma:.2f} m")

    def _on_silence(self, event):
        self._take(None, None, "lss_node is not heard of")

    def _on_publishers(self, event):
        if event.current_count > 1:
            text = (
                f"{event.current_count} publishers of landing/selected: the last one's word counts"
            )
            self.get_logger().warning(text)

    def _take(self, place, header, remark):
        if place == self._target:
            return
        self._target = place
        output = PointStamped()
        output.point.x = output.point.y = output.point.z = math.nan
        if header is not None:
            output.header = header
        if place is None:
            self.get_logger().warning(f"no target: {remark}")
        else:
            output.point = place
            text = f"target {place.x:.2f} {place.y:.2f} {place.z:.2f} m, {remark}"
            self.get_logger().info(text)
        self._output.publish(output)


def main():
    """Runs until it is told to stop."""
    # ROS's own handlers end the context at once, and whatever is being sent fails.
    stop = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.append(True))
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = TargetFollower()
    while not stop:
        rclpy.spin_once(node, timeout_sec=0.2)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
