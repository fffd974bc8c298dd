# SPDX-License-Identifier: Apache-2.0
"""Poses between poses, and scans that wait for them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import mounted
from quadtree_lss.onboard.core.sensing.pose_buffer import PoseBuffer
from quadtree_lss.onboard.core.sensing.scan_queue import ScanQueue

MS = 1_000_000
SECOND = 1000 * MS
EPOCH = 1_700_000_000 * SECOND


def random_pose(stamp_ns, rng):
    root = rng.normal(size=(6, 6))
    rotation = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    return Pose(stamp_ns, rng.normal(size=3), rotation, root @ root.T)


def plain_pose(stamp_ns):
    return Pose(stamp_ns, np.array([stamp_ns / 1e9, 0.0, 0.0]), np.eye(3), np.eye(6))


def buffer_of(*stamps_ms, span_ms=10_000, gap_ms=100):
    buffer = PoseBuffer(span_ms * MS, gap_ms * MS)
    for stamp in stamps_ms:
        buffer.add(plain_pose(stamp * MS))
    return buffer


def queue_of(buffer, scans=5, wait_ms=1000):
    return ScanQueue(buffer, scans, wait_ms * MS)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.0, 1.0))
def test_interpolation_is_linear_and_slerp_as_scipy_has_it(seed, share):
    rng = np.random.default_rng(seed)
    before, after = (random_pose(EPOCH + t * MS, rng) for t in (0, 50))
    buffer = PoseBuffer(SECOND, SECOND)
    buffer.add(before), buffer.add(after)
    stamp = EPOCH + round(share * 50 * MS)
    exact = (stamp - EPOCH) / (50 * MS)
    pose = buffer.pose_at(stamp)
    both = Rotation.from_matrix([before.rotation_map_lidar, after.rotation_map_lidar])
    rotation = Slerp([0.0, 1.0], both)(exact).as_matrix()
    np.testing.assert_allclose(pose.rotation_map_lidar, rotation, atol=1e-9)
    position = before.position + exact * (after.position - before.position)
    np.testing.assert_allclose(pose.position, position, atol=1e-12)
    covariance = before.covariance + exact * (after.covariance - before.covariance)
    np.testing.assert_allclose(pose.covariance, covariance, atol=1e-12)
    assert np.linalg.eigvalsh(pose.covariance)[0] > 0.0
    assert pose.stamp_ns == stamp


@pytest.mark.parametrize("stamp_ms", [-1, 99, 301, 10_000])
def test_never_the_latest_pose_nor_one_beyond_the_ends(stamp_ms):
    buffer = buffer_of(100, 200, 300)
    assert buffer.pose_at(stamp_ms * MS) is None
    assert not buffer.covers(stamp_ms * MS)
    assert PoseBuffer(SECOND, SECOND).pose_at(stamp_ms * MS) is None


def test_a_gap_is_not_bridged_and_an_exact_stamp_needs_no_bracket():
    buffer = buffer_of(0, 100, 301)
    assert buffer.pose_at(50 * MS) is not None
    assert buffer.pose_at(200 * MS) is None
    assert buffer.drop_reason(200 * MS) == "pose_gap"
    assert buffer.pose_at(301 * MS).stamp_ns == 301 * MS


@settings(max_examples=60)
@given(
    stamps=st.lists(st.integers(0, 900), min_size=1, max_size=30),
    asked=st.lists(st.integers(-10, 910), max_size=10),
)
def test_small_disorder_does_not_matter(stamps, asked):
    first = min(stamps)  # older than all that are held would be refused
    disordered, ordered = (PoseBuffer(SECOND, SECOND) for _ in range(2))
    for stamp in [first, *stamps]:
        disordered.add(plain_pose(stamp * MS))
    for stamp in sorted(set(stamps)):
        assert ordered.add(plain_pose(stamp * MS)) is None
    assert len(disordered) == len(ordered) == len(set(stamps))
    for stamp in asked:
        pose, expected = disordered.pose_at(stamp * MS), ordered.pose_at(stamp * MS)
        assert (pose is None) == (expected is None) == (not ordered.covers(stamp * MS))
        if pose is not None:
            np.testing.assert_array_equal(pose.position, expected.position)


def test_a_backward_jump_of_poses_starts_anew():
    buffer = buffer_of(10_000, 10_100)
    assert buffer.add(plain_pose(0)) == "time_jump"
    assert buffer.range_ns == (0, 0) and buffer.jumps == 1
    assert buffer.pose_at(10_050 * MS) is None


def test_waiting_is_bounded_from_arrival_whatever_the_stamps_say():
    for epoch in (0, EPOCH):
        queue = queue_of(PoseBuffer(SECOND, SECOND), wait_ms=300)
        queue.push_scan(epoch, "old stamp", 5000 * MS)
        queue.push_scan(epoch + 50 * MS, "next", 5050 * MS)
        assert queue.expire(5299 * MS) == []
        (drop,) = queue.expire(5300 * MS)
        assert drop.stamp_ns == epoch and drop.reason == "no_pose"
        assert len(queue) == 1
        assert len(queue.expire(5350 * MS)) == 1
        assert queue.dropped == {"no_pose": 2}


def test_scans_that_no_pose_can_help_do_not_hold_up_the_others():
    """Nor is a second scan of the same stamp mapped twice."""
    queue = queue_of(buffer_of(1000, 1500, 1600))
    for stamp in (900, 1200, 1550, 1550):
        queue.push_scan(stamp * MS, stamp, 0)
    assert [scan for _, scan, _ in queue.pop_ready()] == [1550]
    reasons = {d.reason for d in queue.expire(0)}
    assert reasons == set(queue.dropped) == {"before_poses", "pose_gap", "duplicate"}


@pytest.mark.parametrize("poses_first", [True, False])
def test_a_bag_that_begins_again_is_mapped_again(poses_first):
    """Poses of the new time that came before its first scan stay; those of the old time go."""
    buffer = buffer_of(10_000, 10_100)
    queue = queue_of(buffer)
    queue.push_scan(10_050 * MS, "old", 0)
    assert [scan for _, scan, _ in queue.pop_ready()] == ["old"]
    again = [lambda: [buffer.add(plain_pose(stamp * MS)) for stamp in (0, 100)]]
    again.insert(poses_first, lambda: queue.push_scan(50 * MS, "new", 0))
    for step in again:
        step()
    assert [scan for _, scan, _ in queue.pop_ready()] == ["new"]
    assert buffer.range_ns == (0, 100 * MS)


@settings(max_examples=80)
@given(data=st.data(), latency=st.integers(0, 250), period=st.integers(20, 90))
def test_when_it_is_asked_for_does_not_change_what_comes_out(data, latency, period):
    """Live nodes ask after each message, others may ask seldom: the same scans and poses."""
    rng = np.random.default_rng(0)
    poses = [random_pose(t * MS, rng) for t in range(0, 1000, period)]
    scans = [t * MS for t in range(17, 900, 50)]
    events = sorted(
        [(p.stamp_ns + latency * MS, 0, p) for p in poses] + [(s, 1, s) for s in scans],
        key=lambda event: event[:2],
    )

    def run(asks):
        buffer = PoseBuffer(10 * SECOND, 100 * MS)
        queue = ScanQueue(buffer, 1000, 10 * SECOND)
        out = []
        for (_, kind, item), ask in zip(events, asks, strict=True):
            if kind == 0:
                buffer.add(item)
            else:
                queue.push_scan(item, None, item)
            if ask:
                out += queue.pop_ready()
        return out + queue.pop_ready(), queue.dropped

    often_out, often_dropped = run([True] * len(events))
    seldom_out, seldom_dropped = run([data.draw(st.booleans()) for _ in events])
    assert often_dropped == seldom_dropped
    assert [s for s, _, _ in often_out] == [s for s, _, _ in seldom_out]
    for (_, _, one), (_, _, other) in zip(often_out, seldom_out, strict=True):
        np.testing.assert_array_equal(one.position, other.position)
        np.testing.assert_array_equal(one.rotation_map_lidar, other.rotation_map_lidar)


@settings(max_examples=60)
@given(events=st.lists(st.tuples(st.booleans(), st.integers(0, 5000)), max_size=60))
def test_every_scan_is_mapped_dropped_or_waiting(events):
    buffer = PoseBuffer(2 * SECOND, 300 * MS)
    queue = queue_of(buffer, scans=4, wait_ms=50)
    pushed = popped = dropped = 0
    for now, (is_pose, stamp) in enumerate(events):
        if is_pose:
            buffer.add(plain_pose(stamp * MS))
        else:
            queue.push_scan(stamp * MS, None, now * 10 * MS)
            pushed += 1
        ready = queue.pop_ready()
        popped += len(ready)
        assert all(pose.stamp_ns == s for s, _, pose in ready)
        dropped += len(queue.expire(now * 10 * MS))
        assert len(queue) <= 4
        assert pushed == popped + dropped + len(queue)
        assert dropped == queue.dropped.total()
    dropped += len(queue.finish())
    assert pushed == popped + dropped and len(queue) == 0


@pytest.mark.parametrize(
    ("poses_ms", "stamp_ms", "words"),
    [
        ((), 500, ["no pose has arrived", "/nav/pose", "QoS"]),
        ((0, 100), 700, ["0.600 s behind", "pose.max_wait"]),
        ((900, 1000), 700, ["0.200 s older", "s are kept"]),
        ((0, 100, 900), 500, ["0.800 s apart", "limit"]),
        ((0, 100), 10_000_000, ["different clocks"]),
    ],
)
def test_messages_name_topics_stamps_range_and_cause(poses_ms, stamp_ms, words):
    queue = ScanQueue(buffer_of(*poses_ms), 5, 0, "/lidar/points", "/nav/pose")
    queue.push_scan(stamp_ms * MS, None, 0)
    queue.pop_ready()
    (drop,) = queue.expire(0)
    held = [f"{t / 1000:.6f}" for t in (poses_ms[0], poses_ms[-1])] if poses_ms else []
    for word in ["'/lidar/points'", f"{stamp_ms / 1000:.6f}", *held, *words]:
        assert word in drop.text
    assert "\n" not in drop.text


def test_mounted_covariance_is_that_of_perturbed_poses():
    rng = np.random.default_rng(2)
    body, mount = random_pose(0, rng), random_pose(0, rng)
    sigma, lidar = body.covariance, mounted(body, mount)
    jacobian = np.zeros((6, 6))
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        turned = Rotation.from_rotvec(step[3:]).as_matrix() @ body.rotation_map_lidar
        moved = mounted(Pose(0, body.position + step[:3], turned, sigma), mount)
        turn = Rotation.from_matrix(moved.rotation_map_lidar @ lidar.rotation_map_lidar.T)
        jacobian[:3, k] = (moved.position - lidar.position) / 1e-6
        jacobian[3:, k] = turn.as_rotvec() / 1e-6
    np.testing.assert_allclose(lidar.covariance, jacobian @ sigma @ jacobian.T, rtol=1e-4)
