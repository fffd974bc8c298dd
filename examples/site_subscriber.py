#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Follow the target on ``landing/selected`` as a guidance node does.

``lss_node`` keeps a target while landing there is permitted, even if the ranking changes. A
guidance node flies to the last target. It has none after a message without a position (NaN), or
when ``lss_node`` no longer publishes. Run it beside the nodes: ``python3 site_subscriber.py``.
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
DEADLINE = Duration(seconds=1.0)  # lss_node repeats its target within this time


class TargetFollower(Node):
    """Publish the target to fly to on ``guidance/target``; NaN without a target."""

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
                deadline=self._on_deadline_missed, matched=self._on_publishers
            ),
        )

    def _on_selected(self, message):
        place = message.pose.pose.position
        if math.isnan(place.x):
            self._set_target(None, message.header, "withdrawn, see landing/status")
            return
        sigma = math.sqrt(message.pose.covariance[14])
        self._set_target(place, message.header, f"height known to {sigma:.2f} m")

    def _on_deadline_missed(self, event):
        self._set_target(None, None, "lss_node does not publish")

    def _on_publishers(self, event):
        if event.current_count > 1:
            text = f"{event.current_count} publishers of landing/selected; the last message counts"
            self.get_logger().warning(text)

    def _set_target(self, place, header, reason):
        if place == self._target:
            return
        self._target = place
        output = PointStamped()
        output.point.x = output.point.y = output.point.z = math.nan
        if header is not None:
            output.header = header
        if place is None:
            self.get_logger().warning(f"no target: {reason}")
        else:
            output.point = place
            text = f"target {place.x:.2f} {place.y:.2f} {place.z:.2f} m, {reason}"
            self.get_logger().info(text)
        self._output.publish(output)


def main():
    """Run until SIGINT or SIGTERM."""
    # The handlers of rclpy shut down the context at once, so that publishing would fail.
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
