# SPDX-License-Identifier: Apache-2.0
"""Poses of the body and the lidar's mount on it give the poses of the lidar."""

from types import SimpleNamespace

import numpy as np
from messages import samples
from messages.samples import cloud, pose

from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.geometry.rotations import exp, quaternion_from_rotation
from quadtree_lss.onboard.messages.intake import Intake

MS = 1_000_000


def scan(stamp_ms):
    return cloud(np.ones((3, 3)), stamp_ns=stamp_ms * MS)


def transform(stamp_ms, translation, rotation, *frames):
    turn = quaternion_from_rotation(rotation)
    return samples.transform(stamp_ms * MS, translation, turn, *frames)


def test_a_lever_arm_turns_attitude_into_position_covariance():
    rng = np.random.default_rng(3)
    config = config_from_values({"mount.x": 2.0, "mount.z": -1.5, "mount.pitch_deg": 30.0})
    sigma = 1e-3
    covariance = np.diag([0.01, 0.02, 0.03, sigma**2, sigma**2, sigma**2])
    body = exp([0.2, -0.4, 1.0])
    intake = Intake(config)
    xyzw = quaternion_from_rotation(body)
    intake.on_pose(pose(0, (10.0, 20.0, 30.0), xyzw=xyzw, covariance=covariance.ravel()))
    intake.on_cloud(scan(0), 0)
    (ready,) = intake.ready(0)
    arm = np.array([2.0, 0.0, -1.5])
    errors = rng.multivariate_normal(np.zeros(6), covariance, 200_000)
    moved = np.array([10.0, 20.0, 30.0]) + errors[:, :3] + exp(errors[:, 3:]) @ (body @ arm)
    np.testing.assert_allclose(ready.pose.position, [10, 20, 30] + body @ arm, atol=1e-12)
    seen = np.cov(np.column_stack([moved, errors[:, 3:]]).T)
    np.testing.assert_allclose(ready.pose.covariance, seen, atol=3e-4)
    assert ready.pose.covariance[0, 0] > 0.01 and ready.pose.covariance[0, 4] != 0.0
    turned = body @ exp([0.0, np.radians(30.0), 0.0])
    np.testing.assert_allclose(ready.pose.rotation_map_lidar, turned, atol=1e-12)


def test_a_gimbal_is_interpolated_to_the_scan():
    intake = Intake(config_from_values({"mount.source": "gimbal"}))
    for stamp in (0, 100):
        intake.on_pose(pose(stamp * MS, (0.0, 0.0, 5.0)))
    intake.on_cloud(scan(50), 0)
    assert intake.ready(0) == [], "the gimbal is not known yet"
    intake.on_gimbal(transform(0, (0.0, 0.0, 0.0), np.eye(3)))
    intake.on_gimbal(transform(100, (2.0, 0.0, 0.0), exp([0.0, 0.2, 0.0])))
    (ready,) = intake.ready(0)
    np.testing.assert_allclose(ready.pose.position, [1.0, 0.0, 5.0])
    np.testing.assert_allclose(ready.pose.rotation_map_lidar, exp([0.0, 0.1, 0.0]), atol=1e-12)


def test_a_scan_without_gimbal_is_told_as_such():
    config = config_from_values({"mount.source": "gimbal", "pose.max_wait": 0.1})
    intake = Intake(config, gimbal_topic="/my/gimbal")
    for stamp in (0, 100):
        intake.on_pose(pose(stamp * MS))
    intake.on_cloud(scan(50), 0)
    assert intake.ready(200 * MS) == []
    (notice,) = intake.notices()
    assert notice.reason == "gimbal_no_pose"
    assert "no gimbal angle has arrived on '/my/gimbal'" in notice.text
    intake.on_gimbal(transform(0, (0.0, 0.0, 0.0), np.eye(3)))
    intake.on_cloud(scan(60), 0)
    intake.finish()
    (notice,) = intake.notices()
    assert "(1 gimbal angles): gimbal angles are 0.060 s behind" in notice.text
    intake.on_cloud(scan(150), 0)
    intake.finish()
    (notice,) = intake.notices()
    assert notice.reason == "no_pose" and "'nav/pose'" in notice.text
    assert intake.dropped == {"gimbal_no_pose": 2, "no_pose": 1}


def test_axes_turn_the_cloud_under_every_mount():
    """Points with x forward of a lidar that an optical frame describes: the same place."""
    flu = np.array([[7.0, -1.0, -2.0]])
    optical = np.array([[1.0, 2.0, 7.0]])
    rotation = exp([0.3, -0.2, 0.9])

    def mapped(points, **mount):
        values = {f"mount.{key}": value for key, value in mount.items()}
        config = config_from_values({**values, "frames.body": "body"})
        intake = Intake(config)
        intake.on_pose(pose(0, (10.0, 20.0, 30.0)))
        if config.mount.source == "gimbal":
            intake.on_gimbal(transform(0, (1.0, 0.0, 0.0), rotation))
        if config.mount.source == "tf":
            intake.on_transforms(SimpleNamespace(transforms=[transform(0, (1, 0, 0), rotation)]))
        intake.on_cloud(cloud(points, stamp_ns=0), 0)
        (ready,) = intake.ready(0)
        return ready.points_lidar @ ready.pose.rotation_map_lidar.T + ready.pose.position

    for mount in ({}, {"x": 2.0, "pitch_deg": 30.0}, {"source": "gimbal"}, {"source": "tf"}):
        turned = mapped(flu, axes="flu_to_optical", **mount)
        np.testing.assert_allclose(turned, mapped(optical, **mount), atol=1e-6)


def tf_intake(**more):
    return Intake(config_from_values({"mount.source": "tf", "frames.body": "base_link", **more}))


def chain(*links):
    """Static transforms, each (parent, child, translation, rotation)."""
    items = [transform(0, *turned, parent, child) for parent, child, *turned in links]
    return SimpleNamespace(transforms=items)


def test_the_mount_follows_static_transforms_up_and_down():
    first, second, third = exp([0.1, 0.2, 0.3]), exp([1.0, 0.0, -0.5]), exp([0.0, -0.7, 0.2])
    intake = tf_intake()
    intake.on_pose(pose(0, (10.0, 20.0, 30.0)))
    intake.on_cloud(scan(0), 0)
    assert not intake.ready(0)
    up = ("/deck", "/base_link", (0.0, 1.0, 0.5), first)
    down = ("deck", "rig", (3.0, 0.0, 0.0), second), ("rig", "lidar", (0.0, 0.0, -1.0), third)
    intake.on_transforms(chain(up, ("elsewhere", "imu", (1.0, 1.0, 1.0), first)))
    assert not intake.ready(0)
    intake.on_transforms(chain(*down))
    (ready,) = intake.ready(0)
    body_deck = first.T
    place = body_deck @ (np.array([3.0, 0.0, 0.0]) + second @ [0.0, 0.0, -1.0] - [0.0, 1.0, 0.5])
    np.testing.assert_allclose(ready.pose.position, place + [10.0, 20.0, 30.0], atol=1e-12)
    turned = body_deck @ second @ third
    np.testing.assert_allclose(ready.pose.rotation_map_lidar, turned, atol=1e-12)


def test_a_scan_without_a_chain_says_which_frames_were_heard_of():
    intake = tf_intake()
    for stamp_ms in (0, 50):
        intake.on_pose(pose(stamp_ms * MS, (0.0, 0.0, 30.0)))
    intake.on_transforms(chain(("base_link", "imu", (0.0, 0.0, 0.0), np.eye(3))))
    intake.on_cloud(scan(0), 0)
    assert not intake.ready(2_000 * MS)
    assert intake.queue.dropped == {"no_mount": 1}
    (notice,) = intake.notices()
    for word in ("'base_link'", "'lidar'", "base_link, imu"):
        assert word in notice.text


def odometry(stamp_ms, child, position=(0.0, 0.0, 30.0)):
    message = pose(stamp_ms * MS, position)
    message.child_frame_id = child
    return message


def test_odometry_is_taken_for_its_child_frame():
    """The first, or the one that is configured; another would put the map elsewhere."""
    for values, good in (({}, "base_link"), ({"frames.body": "/imu"}, "imu")):
        intake = Intake(config_from_values(values))
        intake.on_pose(odometry(0, good))
        intake.on_pose(odometry(10, "wheel"))
        assert intake.poses_taken == 1 and intake.rejected == {"pose_child_frame": 1}
        (notice,) = intake.notices()
        assert "'wheel'" in notice.text and f"'{good}'" in notice.text
