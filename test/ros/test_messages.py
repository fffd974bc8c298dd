# SPDX-License-Identifier: Apache-2.0
"""Conversion of arrays and messages; rate of publication."""

from functools import partial
from operator import attrgetter

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid, Odometry
from rclpy.serialization import serialize_message
from sensor_msgs.msg import PointCloud2, PointField

from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.nodes.publishing import ChangePublisher
from quadtree_lss.onboard.nodes.ros_messages import cloud_message, deserialised, pose_message

pytestmark = pytest.mark.xdist_group("ros")


def pose_of(kind, rng, frame, child):
    message = kind()
    message.header.frame_id = frame
    message.header.stamp.sec, message.header.stamp.nanosec = -3, 999_999_999
    place, turn = message.pose.pose.position, message.pose.pose.orientation
    place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w = rng.normal(size=7).tolist()
    message.pose.covariance = rng.normal(size=36)
    if kind is Odometry:
        message.child_frame_id = child
    return message


@pytest.mark.parametrize("kind", [PoseWithCovarianceStamped, Odometry])
@pytest.mark.parametrize("frame", ["", "m", "ma", "map", "maps", "größe"])
@pytest.mark.parametrize("child", ["", "b", "base_link"])
def test_pose_deserialisation_equals_rclpy(kind, frame, child):
    message = pose_of(kind, np.random.default_rng(len(frame)), frame, child)
    read = pose_message(serialize_message(message), kind)
    assert not isinstance(read, kind)
    np.testing.assert_array_equal(read.pose.covariance, message.pose.covariance)
    for name in (
        "header.frame_id",
        "header.stamp.sec",
        "header.stamp.nanosec",
        *(f"pose.pose.position.{axis}" for axis in "xyz"),
        *(f"pose.pose.orientation.{axis}" for axis in "xyzw"),
        *["child_frame_id"] * (kind is Odometry),
    ):
        assert attrgetter(name)(read) == attrgetter(name)(message), name


@pytest.mark.parametrize("kind", [PoseWithCovarianceStamped, Odometry])
def test_damaged_poses_are_rejected(kind):
    raw = serialize_message(pose_of(kind, np.random.default_rng(1), "map", "body"))
    for some in (*(raw[:n] for n in range(0, 300, 7)), raw[:12] + b"\xff" * 4 + raw[16:]):
        with pytest.raises(MessageError, match=f"not a {kind.__name__}"):
            pose_message(some, kind)


@pytest.mark.parametrize("frame", ["", "m", "ma", "map", "größe"])
@pytest.mark.parametrize("names", ["", "x", "xyz", ["intensity", "t", "größe"]])
def test_cloud_deserialisation_equals_rclpy(frame, names):
    rng = np.random.default_rng(len(frame) + len(names))
    message = PointCloud2(height=3, width=7, point_step=11, row_step=80, is_dense=not names)
    message.header.frame_id, message.is_bigendian = frame, len(names) > 1
    message.header.stamp.sec, message.header.stamp.nanosec = -3, 999_999_999
    for name in names:
        offset, kind, count = (int(n) for n in rng.integers(0, 200, 3))
        message.fields.append(PointField(name=name, offset=offset, datatype=kind, count=count))
    message.data = rng.integers(0, 256, 30 * len(names), dtype=np.uint8).tobytes()
    read = cloud_message(serialize_message(message))
    assert not isinstance(read, PointCloud2) and bytes(read.data) == bytes(message.data)
    assert (read.header.frame_id, read.header.stamp.sec) == (frame, -3)
    assert read.header.stamp.nanosec == 999_999_999
    for name in "height width is_bigendian point_step row_step is_dense".split():
        assert getattr(read, name) == getattr(message, name), name
    for field, of in zip(read.fields, message.fields, strict=True):
        assert PointField(**vars(field)) == of


@pytest.mark.parametrize("kind", [PointCloud2, OccupancyGrid, Odometry])
def test_damaged_messages_are_rejected(kind):
    raw = serialize_message(kind())
    read = cloud_message if kind is PointCloud2 else partial(deserialised, kind=kind)
    for some in (*(raw[:n] for n in range(0, len(raw) - 8, 7)), raw[:12] + b"\xff" * 4 + raw[16:]):
        with pytest.raises(MessageError, match=f"not a {kind.__name__}"):
            read(some)


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
