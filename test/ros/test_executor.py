# SPDX-License-Identifier: Apache-2.0
"""Subscriptions of `OnDemandGroup` in rclpy's executor."""

import time

import pytest
from std_msgs.msg import Int32

from quadtree_lss.onboard.nodes.qos import OnDemandGroup, stream, subscribe

pytestmark = pytest.mark.xdist_group("ros_executor")


def spin(executor, until, limit=10.0):
    end = time.monotonic() + limit
    while not until():
        assert time.monotonic() < end
        executor.spin_once(0.1)


def test_messages_are_served_only_while_wanted(node, executor):
    heard, wanted = [], []
    group = OnDemandGroup(lambda: bool(wanted))
    subscribe(node, Int32, "ahead", heard.append, stream(9, reliable=True), group=group)
    sender = node.create_publisher(Int32, "ahead", stream(9, reliable=True))
    spin(executor, sender.get_subscription_count)
    sender.publish(Int32(data=1))
    for _ in range(20):
        executor.spin_once(0.05)
    assert not heard
    wanted.append(True)
    spin(executor, lambda: heard)
