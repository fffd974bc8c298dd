# SPDX-License-Identifier: Apache-2.0
"""The installed example as a process."""

import math
import subprocess
import sys

import numpy as np
import pytest
from geometry_msgs.msg import PointStamped, PoseWithCovarianceStamped
from installed import SHARE
from rclpy.duration import Duration
from ros_scene import MAKE

from quadtree_lss.onboard.nodes.qos import latched

pytestmark = pytest.mark.xdist_group("ros")
FOLDER = SHARE / "examples"


def selected(place, stamp_ns=7):
    covariance = np.diag([0.01, 0.04, 0.09, 0.0, 0.0, 0.0])
    return MAKE.pose(stamp_ns, place, (0.0, 0.0, 0.0, 1.0), covariance)


@pytest.fixture
def run(ros):
    """Start an example with its output in a file."""
    processes, logs = [], []

    def start(name, *options):
        log = ros.folder / f"{name}.txt"
        command = [sys.executable, str(FOLDER / f"{name}.py"), "--ros-args", *options]
        with log.open("wb") as output:
            how = {"env": ros.env, "stdout": output, "stderr": subprocess.STDOUT}
            processes.append(subprocess.Popen(command, **how))
            logs.append(log)
        return log

    yield start
    for process, log in zip(processes, logs, strict=True):
        process.terminate()
        assert process.wait() == 0 and "Traceback" not in log.read_text(), log.read_text()


def publisher_of_selected(listener):
    profile = latched()
    profile.deadline = Duration(seconds=1.0)
    return listener.node.create_publisher(PoseWithCovarianceStamped, "landing/selected", profile)


def test_subscriber_prints_the_target_until_it_is_withdrawn(ros, run):
    with ros.listen({"guidance/target": PointStamped}) as listener:
        out = publisher_of_selected(listener)
        log = run("site_subscriber")
        place = lambda: listener.newest["guidance/target"].point.x  # noqa: E731

        def says(x):
            def condition():
                out.publish(selected((x, 2.0, 0.5)))
                there = "guidance/target" in listener.newest
                return there and (place() == x or math.isnan(place()) and math.isnan(x))

            return condition

        listener.until(says(1.0))
        assert "target 1.00 2.00 0.50 m, height known to 0.30 m" in log.read_text()
        listener.until(says(math.nan))
        listener.until(says(4.0))
        listener.until(lambda: math.isnan(place()))  # a dead lss_node is noticed
        assert "publishers of landing/selected" not in log.read_text()
        publisher_of_selected(listener)
        listener.until(lambda: "2 publishers of landing/selected" in log.read_text())
