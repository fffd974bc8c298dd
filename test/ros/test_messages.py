# SPDX-License-Identifier: Apache-2.0
"""Arrays to messages and back; counting and limiting what goes out."""

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from quadtree_lss.onboard.nodes.diagnostics import Problems
from quadtree_lss.onboard.nodes.publishing import ChangePublisher
from quadtree_lss.onboard.nodes.ros_messages import message_maker

pytestmark = pytest.mark.xdist_group("ros")


def test_grid_rows_run_along_y():
    values = np.arange(6, dtype=np.int8).reshape(2, 3)
    grid = message_maker("map").grid(values, (-1.0, 2.0), 0.5, 1_500_000_000)
    assert (grid.info.width, grid.info.height) == (3, 2)
    assert list(grid.data) == [0, 1, 2, 3, 4, 5]
    assert (grid.info.origin.position.x, grid.info.origin.position.y) == (-1.0, 2.0)
    assert (grid.header.stamp.sec, grid.header.stamp.nanosec) == (1, 500_000_000)


def test_the_last_change_is_always_published(ros):
    context = Context()
    rclpy.init(context=context, domain_id=ros.domain)
    node = Node("node", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
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
    executor.shutdown()
    context.try_shutdown()


def test_problems_are_all_counted_and_told_once_per_interval():
    class Log:
        lines: list[str] = []

        def warning(self, message):
            self.lines.append(message)

    problems = Problems(Log(), interval=3600.0)
    for _ in range(5):
        problems.report("size", "too short")
    problems.report("frame", "wrong frame")
    assert problems.counts == {"size": 5, "frame": 1}
    assert Log.lines == ["too short", "wrong frame"]
