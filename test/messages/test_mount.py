# SPDX-License-Identifier: Apache-2.0
"""Poses of the body and the lidar's mount on it give the poses of the lidar."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from messages.samples import cloud, pose

from quadtree_lss.config.settings import ConfigError, MountConfig, config_from_values
from quadtree_lss.core.geometry.rotations import exp, quaternion_from_rotation
from quadtree_lss.core.sensing.mount import fixed_mount
from quadtree_lss.messages.intake import Intake

MS = 1_000_000


def scan(stamp_ms):
    return cloud(np.ones((3, 3)), stamp_ns=stamp_ms * MS)


def transform(stamp_ms, translation, rotation):
    x, y, z = translation
    qx, qy, qz, qw = quaternion_from_rotation(rotation)
    stamp = SimpleNamespace(sec=stamp_ms // 1000, nanosec=stamp_ms % 1000 * MS)
    return SimpleNamespace(
        header=SimpleNamespace(stamp=stamp, frame_id="body"),
        child_frame_id="lidar",
        transform=SimpleNamespace(
            translation=SimpleNamespace(x=x, y=y, z=z),
            rotation=SimpleNamespace(x=qx, y=qy, z=qz, w=qw),
        ),
    )


def test_without_parameters_poses_are_the_lidars():
    assert fixed_mount(MountConfig()) is None
    assert fixed_mount(MountConfig(gimbal=True)) is None


def test_roll_pitch_yaw_turn_about_fixed_axes_in_that_order():
    mount = fixed_mount(MountConfig(roll_deg=90.0, yaw_deg=90.0))
    np.testing.assert_allclose(mount.rotation_map_lidar @ [1.0, 0.0, 0.0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(mount.rotation_map_lidar @ [0.0, 1.0, 0.0], [0, 0, 1], atol=1e-15)
    mount = fixed_mount(MountConfig(pitch_deg=90.0))
    np.testing.assert_allclose(mount.rotation_map_lidar @ [0.0, 0.0, 1.0], [1, 0, 0], atol=1e-15)


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
    intake = Intake(config_from_values({"mount.gimbal": True}))
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
    config = config_from_values({"mount.gimbal": True, "pose.max_wait": 0.1})
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


def test_a_gimbal_and_a_fixed_mount_contradict():
    with pytest.raises(ConfigError, match=r"mount\.gimbal"):
        config_from_values({"mount.gimbal": True, "mount.x": 1.0})
