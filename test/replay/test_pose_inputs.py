# SPDX-License-Identifier: Apache-2.0
"""Poses of a bag as Odometry, mounts from its /tf_static, a gimbal: the map of plain poses."""

import numpy as np
import pytest
from replay.recordings import GROUND, LOOKING_DOWN, POSE, START, Recorder, flight, recording

from quadtree_lss.desk.replay.info import inspect_bag
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.onboard.config.settings import config_from_values

ODOMETRY, TRANSFORMS = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"
TRANSFORM = "geometry_msgs/msg/TransformStamped"


class OdometryRecorder(Recorder):
    """Writes poses of these topics as odometry of ``base_link``."""

    odometry: tuple[str, ...] = ()

    def write(self, topic, message, kind, received_ns):
        if kind == POSE and topic in self.odometry:
            zero = self.type("geometry_msgs/msg/Vector3")(0.0, 0.0, 0.0)
            twist = self.type("geometry_msgs/msg/TwistWithCovariance")(
                self.type("geometry_msgs/msg/Twist")(zero, zero), np.zeros(36)
            )
            message = self.type(ODOMETRY)(message.header, "base_link", message.pose, twist)
            kind = ODOMETRY
        super().write(topic, message, kind, received_ns)

    def transformed(self, stamp_ns, parent, child, translation, xyzw=(0.0, 0.0, 0.0, 1.0)):
        held = self.type("geometry_msgs/msg/Transform")(
            self.type("geometry_msgs/msg/Vector3")(*translation),
            self.type("geometry_msgs/msg/Quaternion")(*xyzw),
        )
        header = super().pose(stamp_ns, (0.0, 0.0, 0.0), frame=parent).header
        return self.type(TRANSFORM)(header, child, held)

    def transform(self, *link, received_ns=START):
        item = self.transformed(START, *link)
        self.write("/tf_static", self.type(TRANSFORMS)([item]), TRANSFORMS, received_ns)


class GimbalRecorder(OdometryRecorder):
    """A level body 2 m above the lidar, which a gimbal holds so that it looks down."""

    def pose(self, stamp_ns, position):
        turn = self.transformed(stamp_ns, "body", "lidar", (0.0, 0.0, -2.0), LOOKING_DOWN)
        self.write("/lidar/gimbal", turn, TRANSFORM, stamp_ns)
        return super().pose(stamp_ns, position + (0.0, 0.0, 2.0), xyzw=(0.0, 0.0, 0.0, 1.0))


def write(path, *, odometry=(), pose_topics=("/nav/pose",), transforms=()):
    """A flight whose poses on some topics are odometry; transforms are (parent, child, place)."""
    with recording(path, OdometryRecorder) as recorder:
        recorder.odometry = odometry
        for link in transforms:
            recorder.transform(*link)
        flight(recorder, pose_topics=pose_topics)
    return path


def mapped(bag, **options):
    values = {key.replace("__", "."): value for key, value in options.pop("values", {}).items()}
    return replay(bag, None, config_from_values({**GROUND, **values}), report=False, **options)


def same(first, second):
    return all(
        np.array_equal(getattr(first.cells, name), getattr(second.cells, name), equal_nan=True)
        for name in ("level", "z", "normal", "covariance")
    )


@pytest.mark.parametrize("ending", ["", ".bag"])
def test_odometry_is_found_by_type_and_gives_the_map_of_poses(tmp_path, ending):
    told = write(tmp_path / f"poses{ending}")
    topics = ("/odometry/filtered",)
    as_odometry = write(tmp_path / f"odometry{ending}", odometry=topics, pose_topics=topics)
    result = mapped(as_odometry)
    assert result.summary["pose_topic"] == topics[0] and result.summary["scans"] == 10
    assert same(result, mapped(told))
    info = inspect_bag(as_odometry, config_from_values(GROUND))
    assert info.pose_topic == topics[0] and info.scans_with_pose == 10 and not info.problems


def test_a_mount_from_tf_static_is_that_of_the_parameters(tmp_path):
    """Wherever the part that is replayed begins: it stands at the start of the bag."""
    links = (("base_link", "rig", (1.0, 0.0, 0.0)), ("rig", "lidar", (0.0, 0.5, -0.25)))
    bag = write(tmp_path / "bag", odometry=("/nav/pose",), transforms=links)
    values = {"mount__x": 1.0, "mount__y": 0.5, "mount__z": -0.25}
    for start in (0.0, 0.3):
        told = mapped(bag, values=values, start=start)
        found = mapped(bag, values={"mount__source": "tf"}, start=start)
        assert found.summary["scans"] == told.summary["scans"] > 5 and same(found, told)
    assert not same(mapped(write(tmp_path / "plain")), told)


@pytest.mark.slow
def test_a_gimbal_moves_the_lidar(tmp_path):
    with recording(tmp_path / "bag", GimbalRecorder) as recorder:
        flight(recorder)
    found = mapped(tmp_path / "bag", values={"mount__source": "gimbal"})
    told = mapped(write(tmp_path / "plain"))
    assert found.summary["scans"] == told.summary["scans"] == 10
    np.testing.assert_array_equal(found.cells.level, told.cells.level)
    np.testing.assert_allclose(found.cells.z, told.cells.z, atol=1e-9)
