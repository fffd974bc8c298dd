# SPDX-License-Identifier: Apache-2.0
"""One leaping pose goes, a jump of navigation stays, and nothing is held back for long."""

import numpy as np
import pytest

from quadtree_lss.onboard.core.geometry.rotations import exp
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.pose_gate import MAX_SUSPECT_POSES, PoseGate

SECOND = 10**9


def pose(number: int, off=(0.0, 0.0, 0.0), turned=0.0, sigma=0.05, period=0.05) -> Pose:
    """Of a lander that descends at 20 m/s, slower every second."""
    time = number * period
    position = np.array([3.0 * time, 0.0, 500.0 - 20.0 * time + 0.8 * time**2])
    covariance = np.diag([sigma**2] * 3 + [1e-6] * 3)
    rotation = exp(np.array([0.0, 0.1 * np.sin(time) + turned, 0.0]))
    return Pose(1 + round(time * SECOND), position + off, rotation, covariance)


def passed(poses: list[Pose]) -> tuple[list[int], PoseGate]:
    """Which of the poses come through."""
    gate = PoseGate(2 * SECOND)
    out = [believed for one in poses for believed in gate.filter(one)]
    return [next(k for k, p in enumerate(poses) if p is believed) for believed in out], gate


@pytest.mark.parametrize("period", [0.005, 0.05, 1.0])
def test_a_steady_flight_passes(period):
    rng = np.random.default_rng(1)
    poses = [pose(k, 0.05 * rng.standard_normal(3), period=period) for k in range(300)]
    assert passed(poses)[0] == list(range(300))


@pytest.mark.parametrize("leap", [{"off": (0, 0, 2e7)}, {"off": (4.0, 0, 0)}, {"turned": 3.0}])
def test_one_that_leaps_is_dropped_and_counted(leap):
    poses = [pose(k) for k in range(20)]
    poses[10] = pose(10, **leap)
    found, gate = passed(poses)
    assert found == [k for k in range(20) if k != 10]
    assert gate.dropped == 1


@pytest.mark.parametrize("unsure", [8, 9, 10])
def test_one_that_says_how_little_it_knows_passes(unsure):
    """Or that follows on such: what leads to it is as little known."""
    poses = [pose(k, sigma=2.0 if k == unsure else 0.05) for k in range(20)]
    poses[10] = pose(10, (4.0, 0.0, 0.0), sigma=2.0 if unsure == 10 else 0.05)
    assert passed(poses)[0] == list(range(20))


def test_a_jump_of_navigation_is_believed_with_the_second_pose():
    poses = [pose(k, (0.0, 0.0, 0.0 if k < 10 else 30.0)) for k in range(20)]
    found, gate = passed(poses)
    assert found == list(range(20))
    assert gate.dropped == 0


def test_wrong_ones_at_the_start_or_at_random_hold_nothing_back_for_long():
    start = [pose(k, (0.0, 0.0, 1e6 if k == 0 else 0.0)) for k in range(12)]
    assert passed(start)[0][-4:] == [8, 9, 10, 11]
    rng = np.random.default_rng(2)
    mad = [pose(k, 1e4 * rng.standard_normal(3)) for k in range(60)]
    steps = np.diff(passed(mad)[0])
    assert len(steps) > 10
    assert steps.max() <= MAX_SUSPECT_POSES
