# SPDX-License-Identifier: Apache-2.0
"""A running mapping_node with a depth camera: images and CameraInfo."""

import numpy as np
import pytest
from ros_scene import MAKE, POSITION, SCAN_NS, START_NS, Sensors, pose
from sensor_msgs.msg import CameraInfo, Image

from quadtree_lss.onboard.nodes.qos import stream
from quadtree_lss.onboard.nodes.ros_messages import packed

SHAPE, FOCAL = (48, 64), 200.0
pytestmark = pytest.mark.xdist_group("ros")


class CameraSensors(Sensors):
    """Sensors with depth images of level ground 100 m below."""

    def __init__(self, listener) -> None:
        super().__init__(listener)
        node, profile = listener.node, stream(100, reliable=True)
        listener.forget(self.scans)
        self.scans = node.create_publisher(Image, "depth/image", profile)
        self.camera = node.create_publisher(CameraInfo, "depth/camera_info", profile)

    def image(self, stamp_ns, points_lidar):
        self.camera.publish(MAKE.camera(stamp_ns, *SHAPE, FOCAL))
        message = MAKE.depth(stamp_ns, np.full(SHAPE, np.nan))
        message.encoding, message.step = "32FC1", 4 * SHAPE[1]
        message.data = packed(np.full(SHAPE, POSITION[2], "<f4").view(np.uint8).reshape(-1))
        return message


def test_a_depth_camera_is_mapped_live(ros):
    mapping = ros.start("mapping_node", "-p", "lidar.source:=depth")
    with ros.listen() as listener:
        sensors = CameraSensors(listener).matched()
        # The first image may come before its CameraInfo, on another topic, and is not used then.
        sensors.map(4, make_cloud=sensors.image, make_pose=pose)
        assert listener.stamp("map/cells") == START_NS + 3 * SCAN_NS

        def unusable_are_counted():
            sensors.camera.publish(CameraInfo())
            sensors.scans.publish(Image())
            problems = "".join(listener.values())
            return "problems.camera_info" in problems and "problems.cloud" in problems

        listener.until(unusable_are_counted)
    assert "Traceback" not in mapping.output()
