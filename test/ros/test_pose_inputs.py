# SPDX-License-Identifier: Apache-2.0
"""A running mapping_node with odometry, with a gimbal, and with a mount from /tf_static."""

import importlib.util

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from ros_scene import BLOCK, Sensors, gimbal, level_body, pose

from quadtree_lss.onboard.messages.outputs import map_from_messages
from quadtree_lss.onboard.nodes.node_runner import WRONG_CONFIGURATION
from quadtree_lss.onboard.nodes.qos import latched, stream

pytestmark = pytest.mark.xdist_group("ros")
has_tf = importlib.util.find_spec("tf2_msgs") is not None


def odometry(stamp_ns: int, held=pose) -> Odometry:
    """The same pose, of ``base_link``."""
    message = held(stamp_ns)
    return Odometry(header=message.header, child_frame_id="base_link", pose=message.pose)


class OdometrySensors(Sensors):
    """Sensors with poses as odometry."""

    def __init__(self, listener, *, reliable=True) -> None:
        super().__init__(listener)
        listener.forget(self.poses)
        profile = stream(100, reliable=reliable)
        self.poses = listener.node.create_publisher(Odometry, "odometry/filtered", profile)


@pytest.mark.slow
def test_best_effort_odometry_is_logged_with_the_fix(ros):
    """MAVROS publishes odometry with best effort."""
    options = ("-p", "pose.source:=odometry", "-r", "nav/odometry:=odometry/filtered")
    override = "qos_overrides./odometry/filtered.subscription.reliability"
    deaf = ros.start("mapping_node", *options)
    with ros.listen() as listener:
        sensors = OdometrySensors(listener, reliable=False)
        listener.until(sensors.scans.get_subscription_count)
        sensors.publish(4, make_pose=odometry)
        listener.until(lambda: f"{override}: best_effort" in deaf.output())
        assert deaf.stop() == 0
        ros.start("mapping_node", *options, "-p", f"{override}:=best_effort")
        sensors.matched().map(4, make_pose=odometry)


def test_a_gimbal_moves_the_lidar(ros):
    """Map ground with a slope of 2 % from a level body 2 m above the lidar."""
    ros.start("mapping_node", "-p", "mount.source:=gimbal")
    with ros.sensors() as (listener, sensors):
        profile = stream(100, reliable=True)
        angles = listener.node.create_publisher(TransformStamped, "lidar/gimbal", profile)
        listener.until(angles.get_subscription_count)

        def both(stamp):
            angles.publish(gimbal(stamp, (0.0, 0.0, -2.0)))
            return level_body(stamp, 2.0)

        sensors.map(4, make_pose=both)
        newest = listener.newest
        cells = map_from_messages(newest["map/cells"], newest["map/observed"])
    beside = cells.measured & (cells.x + cells.size < BLOCK[0])
    assert beside.sum() > 20
    np.testing.assert_allclose(cells.z[beside], 0.02 * cells.x[beside], atol=0.05)


def test_unused_pose_topic_is_reported(ros):
    mapping = ros.start("mapping_node", "-r", "nav/odometry:=odometry/filtered")
    with ros.listen() as listener:
        OdometrySensors(listener)
        hint = "'/odometry/filtered' is published: set pose.source to odometry to use it"
        listener.until(listener.told, "mapping_node", (), hint)
    assert mapping.stop() == 0


@pytest.mark.skipif(has_tf, reason="tf2_msgs is there")
def test_mount_from_tf_without_tf2_msgs_is_a_configuration_error(ros):
    node = ros.start("mapping_node", "-p", "mount.source:=tf")
    assert node.process.wait(30.0) == WRONG_CONFIGURATION
    assert node.output().splitlines()[-1].startswith("error: mount.source tf needs tf2_msgs")


@pytest.mark.skipif(not has_tf, reason="tf2_msgs comes with ROS, not with its wheels")
def test_a_mount_comes_from_tf_static(ros):
    from tf2_msgs.msg import TFMessage

    ros.start("mapping_node", "-p", "mount.source:=tf", "-p", "frames.body:=base_link")
    with ros.listen() as listener:
        link = TransformStamped(child_frame_id="lidar")
        link.header.frame_id = "base_link"
        link.transform.translation.z, link.transform.rotation.x = -2.0, 1.0
        link.transform.rotation.w = 0.0
        tf = listener.node.create_publisher(TFMessage, "/tf_static", latched())
        tf.publish(TFMessage(transforms=[link]))
        sensors = Sensors(listener).matched()
        sensors.map(4, make_pose=lambda stamp_ns: level_body(stamp_ns, 2.0))
