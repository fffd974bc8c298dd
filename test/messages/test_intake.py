# SPDX-License-Identifier: Apache-2.0
"""From messages to scans with their pose: nothing raises, everything is counted and told."""

import numpy as np
import pytest
from fuzz.cases import FRAMES
from messages.samples import cloud, pose

from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages.intake import Intake
from quadtree_lss.onboard.messages.lost_points import unused_points_text

MS = 1_000_000
CONFIG = config_from_values({"pose.max_wait": 0.2})


def scan(stamp_ms, n=5):
    return cloud(np.full((n, 3), float(stamp_ms)), stamp_ns=stamp_ms * MS)


def test_a_scan_between_two_poses_is_ready_with_the_pose_between():
    intake = Intake(CONFIG)
    intake.on_pose(pose(0, (0.0, 0.0, 0.0)))
    assert intake.on_cloud(scan(50), 0) == 50 * MS
    assert intake.ready(0) == []
    intake.on_pose(pose(100 * MS, (10.0, 0.0, 0.0)))
    (ready,) = intake.ready(0)
    assert ready.stamp_ns == ready.pose.stamp_ns == 50 * MS
    np.testing.assert_allclose(ready.pose.position, [5.0, 0.0, 0.0])
    np.testing.assert_array_equal(ready.points_lidar, np.full((5, 3), 50.0))
    assert intake.notices() == [] and not intake.dropped and not intake.rejected


def test_bad_messages_are_counted_by_reason_and_told_once_each():
    intake = Intake(CONFIG)
    wrong = scan(10)
    wrong.width += 1
    assert intake.on_cloud(wrong, 0) is None
    intake.on_cloud(scan(20, n=0), 0)
    intake.on_pose(pose(0, frame="odom"))
    intake.on_pose(pose(0, xyzw=(0, 0, 0, 0)))
    intake.on_pose(pose(0, covariance=np.ones(35)))
    expected = ["cloud_size", "cloud_empty"]
    expected += ["pose_frame", "pose_quaternion", "pose_covariance"]
    assert [notice.reason for notice in intake.notices()] == expected
    assert intake.notices() == []
    assert intake.rejected == dict.fromkeys(expected, 1)
    assert intake.dropped == {"cloud_size": 1, "cloud_empty": 1}


def test_unknown_covariance_is_told_and_replaced():
    intake = Intake(CONFIG)
    intake.on_pose(pose(50 * MS, covariance=np.zeros(36)))
    intake.on_cloud(scan(50), 0)
    (ready,) = intake.ready(0)
    assert ready.pose.covariance[0, 0] == CONFIG.pose.unknown_position_sigma**2
    (notice,) = intake.notices()
    assert notice.reason == "pose_covariance_unknown"
    assert "(pose.unknown_position_sigma, pose.unknown_attitude_sigma_deg)" in notice.text


def test_scans_without_a_pose_are_given_up_and_those_behind_them_come():
    intake = Intake(CONFIG, scan_topic="/s", pose_topic="/p")
    intake.on_pose(pose(1000 * MS))
    intake.on_cloud(scan(1500), 0)
    intake.on_cloud(scan(1000), 0)
    assert intake.ready(199 * MS) == []
    assert [ready.stamp_ns for ready in intake.ready(200 * MS)] == [1000 * MS]
    (notice,) = intake.notices()
    assert notice.reason == "no_pose" and "'/s'" in notice.text and "'/p'" in notice.text
    intake.on_cloud(scan(9000), 0)
    intake.finish()
    assert intake.dropped == {"no_pose": 2} and len(intake.notices()) == 1


def unused(points, **values):
    """Text for one scan from 100 m above (50, 0), looking down; domain x and y -32 ... 32 m."""
    values = {"domain.xmin": -32.0, "domain.ymin": -32.0, "domain.size": 64.0, **values}
    mapper = Mapper(config_from_values(values))
    down = np.diag([1.0, -1.0, -1.0])
    pose = Pose(1_500_000_000, np.array([50.0, 0.0, 100.0]), down, np.zeros((6, 6)))
    return unused_points_text(mapper.update(np.array(points), pose), mapper.domain)


def test_a_scan_of_which_nothing_enters_the_map_says_why_and_where():
    assert unused([[-30.0, 0.0, 100.0], [0.0, 0.0, 100.0]]) is None
    text = unused([[0.0, 0.0, 100.0], [2.0, 4.0, 100.0], [np.nan] * 3])
    assert "scan 1.500000 s" in text
    assert "2 outside the domain, 1 without a return" in text
    assert "x -32 ... 32, y -32 ... 32 m" in text
    assert "middle is at x 51.0, y -2.0" in text
    text = unused([[np.nan] * 3] * 4)
    assert "4 without a return" in text and "x -32" not in text and "middle" not in text
    far = unused([[0.0, 0.0, 100.0]], **{"lidar.max_range": 50.0})
    assert "1 out of range (lidar.min_range, lidar.max_range)" in far


@pytest.mark.parametrize("text", [*FRAMES, "a\tb\r\nc", "caf\u00e9 \u2026", "\ud800", "\x00"])
def test_text_from_outside_is_one_printable_line(text):
    line = one_line(text, 100)
    assert line.isprintable() and "\n" not in line and len(line) < 140
    assert line == text or not text.isprintable() or len(text) > 100
