#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Keeps a landing target from ``landing/sites``: the example of docs/guidance.md.

The target stays as long as the ranking still offers a site within HOLD of it; otherwise the first
site is taken. Run it beside the nodes: ``python3 examples/site_subscriber.py``.
"""

import math

import rclpy
from geometry_msgs.msg import PointStamped, PoseArray
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

HOLD = 2.0  # m, horizontal
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


class TargetKeeper(Node):
    """Publishes the held target on ``guidance/target``."""

    def __init__(self):
        super().__init__("target_keeper")
        self._target = None
        self._output = self.create_publisher(PointStamped, "guidance/target", LATCHED)
        self.create_subscription(PoseArray, "landing/sites", self._on_sites, LATCHED)

    def _on_sites(self, message):
        sites = [pose.position for pose in message.poses]
        if not sites:
            self._target = None
            self.get_logger().warning("no safe site on the present map")
            return
        target = choose(self._target, sites)
        if self._target is None or distance(target, self._target) > HOLD:
            self.get_logger().info(f"target {target.x:.2f} {target.y:.2f} {target.z:.2f} m")
        self._target = target
        self._output.publish(PointStamped(header=message.header, point=target))


def distance(a, b):
    """Horizontal, m."""
    return math.hypot(a.x - b.x, a.y - b.y)


def choose(held, sites):
    """The site nearest to the held target if it is within HOLD, else the best one."""
    if held is None:
        return sites[0]
    nearest = min(sites, key=lambda site: distance(site, held))
    return nearest if distance(nearest, held) <= HOLD else sites[0]


def main():
    """Runs until it is told to stop."""
    rclpy.init()
    node = TargetKeeper()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
