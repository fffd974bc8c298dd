# SPDX-License-Identifier: Apache-2.0
"""Frame conversions compared with SciPy's rotations; remote clock; jumps."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadtree_lss.onboard.autopilot.frames import (
    JumpDetector,
    Nav,
    RemoteClock,
    attitude,
    body_frd,
    covariance_enu,
    enu,
)

RNG = np.random.default_rng(70001)
ATTITUDES = Rotation.random(20, random_state=70002)


def mavlink(rotation):
    """w, x, y, z."""
    return rotation.as_quat()[[3, 0, 1, 2]]


@pytest.mark.parametrize("k", range(20))
def test_attitude_preserves_directions_of_body_axes(k):
    """Compare each body axis in NED and in ENU."""
    ned_frd = ATTITUDES[k]
    enu_flu = Rotation.from_quat(attitude(mavlink(ned_frd)))
    for flu, frd in (((1, 0, 0), (1, 0, 0)), ((0, 1, 0), (0, -1, 0)), ((0, 0, 1), (0, 0, -1))):
        north, east, down = ned_frd.apply(frd)
        np.testing.assert_allclose(enu_flu.apply(flu), [east, north, -down], atol=1e-12)


def test_body_frd_of_a_place():
    for k in range(20):
        vector_ned = RNG.normal(size=3)
        seen = body_frd(enu(vector_ned), attitude(mavlink(ATTITUDES[k])))
        np.testing.assert_allclose(seen, ATTITUDES[k].inv().apply(vector_ned), atol=1e-12)


@pytest.mark.parametrize("k", range(2))
def test_covariance_enu_matches_sampled_errors(k):
    """Monte Carlo: errors drawn in the autopilot's convention and rotated have this covariance.

    The pose's error along ROS's fixed axes is what the true attitude must be turned by.
    """
    root = np.diag([0.3, 0.2, 0.1, 0.02, 0.01, 0.005]) @ (np.eye(6) + 0.3 * RNG.normal(size=(6, 6)))
    ned_frd, covariance = ATTITUDES[k], root @ root.T
    drawn = RNG.normal(size=(2_000, 6)) @ root.T
    moved = np.array([enu(d) for d in drawn[:, :3]])
    true = Rotation.from_quat(attitude(mavlink(ned_frd)))
    wrong = [attitude(mavlink(ned_frd * Rotation.from_rotvec(d))) for d in drawn[:, 3:]]
    turned = (Rotation.from_quat(wrong) * true.inv()).as_rotvec()
    seen = np.cov(np.hstack([moved, turned]).T)
    told = covariance_enu(covariance[np.triu_indices(6)], true.as_quat())
    scale = np.sqrt(np.outer(told.diagonal(), told.diagonal()))
    np.testing.assert_allclose(seen / scale, told / scale, atol=0.1)


def test_unknown_covariance_is_none():
    level = np.array([0.0, 0.0, 0.0, 1.0])
    assert covariance_enu(np.full(21, np.nan), level) is None
    assert covariance_enu(np.zeros(21), level) is None


def test_clock_error_is_at_most_half_the_fastest_exchange():
    """Use asymmetric round trips of a loaded computer: a few fast, most slow."""
    clock, true = RemoteClock(), 5_000_000_000_000
    assert clock.offset_ns is None
    for k in range(200):
        there, back = (RNG.exponential(8e6, 2) + 3e5).astype(int)
        sent = 10**15 + k * 200_000_000
        clock.add(sent, sent + there - true, sent + there + back)
    assert abs(clock.offset_ns - true) <= clock.uncertainty_ns < 4e6


def test_restarted_clock_is_followed_immediately():
    clock = RemoteClock()
    for k in range(10):
        clock.add(k * 10**9, k * 10**9 - 100, k * 10**9 + 10**6)
    clock.add(11 * 10**9, 5, 11 * 10**9 + 2 * 10**6)
    assert clock.offset_ns == 11 * 10**9 + 10**6 - 5


def test_largest_offset_is_used_with_a_stepped_clock():
    clock = RemoteClock()
    for waited in (30, 10, 50):
        clock.add(10**9, 10**9 + waited * 10**6, 10**9)
    assert clock.offset_ns == -(10**7) and clock.uncertainty_ns == 0


def nav(own_s, x, speed, offset_s=0.0):
    place, velocity = np.array([x, 0.0, 9.0]), np.array([speed, 0.0, 0.0])
    stamp, level = round(1e9 * (own_s + offset_s)), np.array([0.0, 0.0, 0.0, 1.0])
    return Nav(stamp, place, level, velocity, None, round(1e9 * own_s))


def test_jump_is_motion_that_velocity_does_not_explain():
    jumps = JumpDetector()
    assert jumps.jump(nav(0.0, 0.0, 5.0)) == 0.0
    assert jumps.jump(nav(0.1, 0.5, 5.0)) == pytest.approx(0.0, abs=1e-9)
    assert jumps.jump(nav(0.2, 2.0, 5.0)) == pytest.approx(1.0)
    better = nav(0.3, 2.5, 5.0, offset_s=-0.2)
    assert jumps.jump(better) == pytest.approx(0.0, abs=1e-9), "its clock is better known, no more"


@pytest.mark.parametrize(
    ("gap", "way", "speed", "size"),
    [
        (1.6, 1.6, 1.0, 0.0),  # it flew on
        (1.6, 0.4, 0.0, 0.0),  # it stopped on the way
        (1.6, -6.5, 1.0, 6.5),
        (1.6, 20.0, 1.0, 18.4),
        (60.0, 20.0, 1.0, 17.0),  # it had no set-points to fly on
        (-5.0, 3.0, 1.0, 3.0),  # the autopilot started anew
    ],
)
def test_velocity_is_integrated_over_limited_gaps(gap, way, speed, size):
    jumps = JumpDetector()
    jumps.jump(nav(10.0, 0.0, 1.0))
    assert jumps.jump(nav(10.0 + gap, way, speed)) == pytest.approx(size)
