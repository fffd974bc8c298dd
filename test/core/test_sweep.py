# SPDX-License-Identifier: Apache-2.0
"""Scans that take time: every point is where the lidar saw it from, and waits for that pose."""

import numpy as np
import pytest
from core.builders import configured
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import MountedPoses, mounted
from quadtree_lss.onboard.core.sensing.pose_buffer import PoseBuffer
from quadtree_lss.onboard.core.sensing.register import register
from quadtree_lss.onboard.core.sensing.scan_queue import ScanQueue
from quadtree_lss.onboard.core.sensing.sweep import interpolate_sweep, poses_during
from quadtree_lss.onboard.core.tree.domain import Domain

MS = 1_000_000
SECOND = 1000 * MS
STAMP = 1_700_000_000 * SECOND


def pose_at(ms: float, position=(0.0, 0.0, 0.0), turned=(0.0, 0.0, 0.0)) -> Pose:
    rotation = Rotation.from_rotvec(turned).as_matrix()
    return Pose(STAMP + round(ms * MS), np.array(position), rotation, 1e-12 * np.eye(6))


def buffer_of(poses: list[Pose], gap_ms: float = 200.0) -> PoseBuffer:
    buffer = PoseBuffer(10 * SECOND, round(gap_ms * MS))
    for pose in poses:
        buffer.add(pose)
    return buffer


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(2, 9), st.booleans())
def test_each_point_is_turned_and_moved_by_the_pose_at_its_time(seed, count, shuffled):
    rng = np.random.default_rng(seed)
    knots = np.sort(rng.choice(np.arange(-50, 150), count, replace=False)).astype(float)
    knots[0], knots[-1] = -60.0, 160.0
    above = np.array([8.0, 8.0, 50.0])
    poses = [pose_at(t, above + rng.normal(size=3), rng.normal(0.0, 0.2, 3)) for t in knots]
    buffer = buffer_of(poses, 300.0)
    times = rng.uniform(-55.0, 155.0, 200)
    times = times if shuffled else np.sort(times)
    offsets = np.rint(times * MS).astype(np.int32)
    points = rng.normal(0.0, 3.0, (200, 3)) + (0.0, 0.0, -40.0)
    at_stamp = buffer.pose_at(STAMP)
    during = poses_during(buffer, STAMP + int(offsets.min()), STAMP + int(offsets.max()))
    config = configured(domain={"xmin": -100.0, "ymin": -100.0, "size": 200.0})
    moved = interpolate_sweep(offsets, at_stamp, during)
    seen, dropped = register(points, at_stamp, config.lidar, Domain.of(config.domain), moved)
    assert not any(dropped.values())
    turns = Slerp(knots, Rotation.from_matrix([pose.rotation_map_lidar for pose in poses]))
    ways = [np.interp(offsets / MS, knots, [pose.position[k] for pose in poses]) for k in range(3)]
    expected = turns(offsets / MS).apply(points) + np.stack(ways, axis=1)
    distance, which = cKDTree(seen.points + seen.pose.position).query(expected)
    assert distance.max() < 1e-4
    assert len(np.unique(which)) == len(seen.points) == len(points)


def waiting(buffer, span_ms, stamp_ms=0.0) -> ScanQueue:
    queue = ScanQueue(buffer, 5, SECOND)
    span = tuple(round(t * MS) for t in span_ms)
    queue.push_scan(STAMP + round(stamp_ms * MS), "scan", 0, span)
    return queue


def test_a_scan_waits_until_poses_reach_its_last_point():
    buffer = buffer_of([pose_at(t) for t in (-20, 0, 50)])
    queue = waiting(buffer, (0.0, 99.0))
    assert queue.pop_ready() == []
    buffer.add(pose_at(98))
    assert queue.pop_ready() == []
    buffer.add(pose_at(100))
    assert [scan for _, scan, _ in queue.pop_ready()] == ["scan"]


@pytest.mark.parametrize(
    ("poses_ms", "span_ms", "reason"),
    [
        ((-20, 0, 200), (-90.0, 0.0), "before_poses"),
        ((-20, 0, 10, 220, 230), (0.0, 225.0), "pose_gap"),
        ((-20, 0, 10, 50), (0.0, 99.0), "no_pose"),
    ],
)
def test_what_the_span_lacks_is_the_reason_and_named(poses_ms, span_ms, reason):
    queue = waiting(buffer_of([pose_at(t) for t in poses_ms]), span_ms)
    assert queue.pop_ready() == []
    (drop,) = queue.expire(2 * SECOND)
    assert drop.reason == reason
    assert "its points are of" in drop.text and "\n" not in drop.text


def test_a_gimbal_counts_as_the_poses_do():
    body = buffer_of([pose_at(t, (t / 100.0, 0.0, 0.0)) for t in (0, 100)])
    gimbal = buffer_of([pose_at(t, turned=(t / 100.0, 0.0, 0.0)) for t in (0, 40, 60)])
    source = MountedPoses(body, gimbal)
    queue = waiting(source, (0.0, 80.0))
    assert queue.pop_ready() == []
    gimbal.add(pose_at(90, turned=(0.9, 0.0, 0.0)))
    assert len(queue.pop_ready()) == 1
    during = poses_during(source, STAMP, STAMP + 80 * MS)
    assert [pose.stamp_ns - STAMP for pose in during] == [0, 40 * MS, 60 * MS, 80 * MS]
    expected = mounted(body.pose_at(STAMP + 60 * MS), gimbal.pose_at(STAMP + 60 * MS))
    np.testing.assert_array_equal(during[2].rotation_map_lidar, expected.rotation_map_lidar)
