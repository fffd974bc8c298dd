# SPDX-License-Identifier: Apache-2.0
"""Damaged messages; rate of publication."""

import pytest
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2

from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.nodes.publishing import ChangePublisher
from quadtree_lss.onboard.nodes.ros_messages import deserialised

pytestmark = pytest.mark.xdist_group("ros")


@pytest.mark.parametrize("kind", [PointCloud2, OccupancyGrid, Odometry])
def test_damaged_messages_are_rejected(kind):
    raw = serialize_message(kind())
    for some in (*(raw[:n] for n in range(0, len(raw) - 8, 7)), raw[:12] + b"\xff" * 4 + raw[16:]):
        with pytest.raises(MessageError, match=f"not a {kind.__name__}"):
            deserialised(some, kind)


def test_the_last_change_is_always_published(node, executor):
    state, sent = [0], []
    publisher = ChangePublisher(node, 20.0, lambda: sent.append(state[0]))
    for _ in range(3):
        for _ in range(40):
            state[0] += 1
            publisher.changed()
        while not sent or sent[-1] != state[0]:
            executor.spin_once(timeout_sec=1.0)
    assert len(sent) < state[0] / 4
    before = len(sent)
    executor.spin_once(timeout_sec=0.2)
    assert len(sent) == before, "without a change nothing is published"
