# SPDX-License-Identifier: Apache-2.0
"""What ``info`` finds in a bag agrees with what was recorded and what a replay does with it."""

import pytest
from replay.recordings import CLOUD, POSE, SECOND, START, recording, write_ros2

from quadtree_lss.desk.replay.info import inspect_bag
from quadtree_lss.onboard.config.settings import Config, config_from_values

CONFIG = Config()


def topic(info, name):
    (found,) = (t for t in info.topics if t.name == name)
    return found


@pytest.mark.parametrize("name", ["flight", "flight.bag"])
def test_a_good_bag(tmp_path, name):
    info = inspect_bag(write_ros2(tmp_path / name), CONFIG)
    assert info.works and info.kind == "scans"
    assert (info.scan_topic, info.pose_topic) == ("/lidar/points", "/nav/pose")
    assert info.scans_with_pose == 10 and not any(info.scans_dropped.values())
    scans, poses = topic(info, "/lidar/points"), topic(info, "/nav/pose")
    assert (scans.count, poses.count) == (10, 22)
    assert scans.rate == pytest.approx(10.0) and poses.rate == pytest.approx(20.0)
    assert scans.delay == pytest.approx(0.005) and poses.delay == pytest.approx(0.002)
    assert scans.frames == {"lidar": 10} and poses.frames == {"map": 22}
    assert scans.first_stamp_ns == START + SECOND // 50 and scans.backward == 0
    assert scans.points == 576
    assert "x float32 @0" in scans.layout and "24 x 24 organised" in scans.layout
    assert "ready to replay" in info.table()


def test_a_domain_that_no_point_reaches_is_a_problem(tmp_path):
    path = write_ros2(tmp_path / "bag")
    good = inspect_bag(path, CONFIG)
    assert good.points == 5760 and sum(good.points_dropped.values()) < 100
    info = inspect_bag(path, config_from_values({"domain.xmin": 5000.0}))
    assert not info.works and info.points_dropped["outside"] == info.points == 5760
    (problem,) = info.problems
    assert "none of 5760 points" in problem and "x 5000 ..." in problem and "middle" in problem
    assert "points 0 of 5760 used (100 % outside the domain)" in info.table()
    assert "cannot be replayed" in info.table()
    info = inspect_bag(path, config_from_values({"domain.ymin": 8.0}))
    assert info.works and any("only " in line for line in info.notes)


def write(path, scans, poses):
    """A bag of scans and poses at given stamps, received as they are listed."""
    with recording(path) as recorder:
        points = [[[0.1 * k, 0.1 * j, 50.0] for k in range(4)] for j in range(4)]
        for k, stamp in enumerate(poses):
            at = START + k * SECOND // 10
            recorder.write("/nav/pose", recorder.pose(stamp, (0, 0, 50)), POSE, at)
        for k, stamp in enumerate(scans):
            at = START + k * SECOND // 10
            recorder.write("/lidar/points", recorder.cloud(stamp, points), CLOUD, at)
    return path
