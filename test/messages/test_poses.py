# SPDX-License-Identifier: Apache-2.0
"""Poses: what is mended, what is refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from messages.samples import pose, transform
from scipy.spatial.transform import Rotation

from quadtree_lss.onboard.messages.clouds import MessageError
from quadtree_lss.onboard.messages.poses import (
    covariance_flaw,
    mount_from_message,
    pose_from_message,
)

COVARIANCE = np.diag([0.04, 0.04, 0.09, 1e-6, 1e-6, 1e-6])


def reason_of(msg, frame="map"):
    with pytest.raises(MessageError) as caught:
        pose_from_message(msg, frame)
    assert "\n" not in str(caught.value)
    return caught.value.reason


@settings(max_examples=50)
@given(seed=st.integers(0, 2**32 - 1), length=st.floats(0.991, 1.009))
def test_a_pose_comes_out_as_it_went_in(seed, length):
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.normal(size=3))
    root = rng.normal(size=(6, 6)) * np.array([1, 1, 1, 1e-3, 1e-3, 1e-3])[:, None]
    covariance = root @ root.T
    msg = pose(123_456_789_012, rng.normal(size=3), length * rotation.as_quat(), covariance)
    decoded = pose_from_message(msg, "map")
    assert decoded.stamp_ns == 123_456_789_012
    np.testing.assert_allclose(decoded.rotation_map_lidar, rotation.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(decoded.covariance, covariance, rtol=1e-9, atol=1e-15)
    np.testing.assert_array_equal(decoded.covariance, decoded.covariance.T)


def test_frames_are_compared_without_leading_slash():
    assert pose_from_message(pose(frame="/map"), "map").stamp_ns == 0
    assert reason_of(pose(frame="odom")) == "frame"
    assert reason_of(pose(frame="")) == "frame"
    with pytest.raises(MessageError, match="'odom'.*'map'"):
        pose_from_message(pose(frame="odom"), "map")


@pytest.mark.parametrize(
    "xyzw", [(0, 0, 0, 0), (0, 0, 0, 1.02), (0, 0, 0, 0.98), (np.nan, 0, 0, 1), (np.inf, 0, 0, 1)]
)
def test_quaternions_that_are_no_rotation_are_refused(xyzw):
    assert reason_of(pose(xyzw=xyzw)) == "quaternion"


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_positions_must_be_finite_and_on_this_planet(bad):
    assert reason_of(pose(position=(0.0, bad, 0.0))) == "position"


def changed(entries):
    covariance = COVARIANCE.copy()
    for place, value in entries.items():
        covariance[place] = value
    return covariance


def test_an_attitude_that_is_hardly_known_and_a_wrong_length_are_refused():
    assert reason_of(pose(covariance=changed({(4, 4): 1.0}))) == "attitude"
    assert reason_of(pose(covariance=np.ones(35))) == "covariance"


@pytest.mark.parametrize(
    "covariance",
    [
        changed({(0, 1): 0.01, (1, 0): 0.02}),
        changed({(3, 4): 1e-8, (4, 3): 2e-8}),
        changed({(0, 1): np.inf, (1, 0): np.inf}),
        changed({(0, 1): 0.05, (1, 0): 0.05}),
        changed({(0, 1): 1e200, (1, 0): -1e200}),
    ],
)
def test_of_a_matrix_that_is_no_covariance_the_variances_count(covariance):
    msg = pose(covariance=covariance)
    assert covariance_flaw(msg) == "invalid"
    found = pose_from_message(msg, "map").covariance
    np.testing.assert_allclose(found, np.diag(covariance.diagonal()), rtol=1e-12)


@pytest.mark.parametrize("axis", [3, 4, 5])
def test_an_attitude_known_to_less_than_half_a_radian_is_refused(axis):
    known, unknown = (changed({(axis, axis): variance}) for variance in (0.24, 0.26))
    assert pose_from_message(pose(covariance=known), "map").covariance[axis, axis] == 0.24
    assert reason_of(pose(covariance=unknown)) == "attitude"


def test_rounding_of_a_covariance_is_mended():
    near = 0.04 * (1.0 + 1e-9)
    covariance = changed({(0, 1): near, (1, 0): near + 1e-12})
    assert np.linalg.eigvalsh(0.5 * (covariance + covariance.T))[0] < 0.0
    mended = pose_from_message(pose(covariance=covariance), "map").covariance
    np.testing.assert_allclose(mended, 0.5 * (covariance + covariance.T), atol=1e-9)
    np.testing.assert_array_equal(mended, mended.T)
    assert np.linalg.eigvalsh(mended)[0] > -1e-16


UNKNOWN = {
    "not a number": (np.full(36, np.nan), range(6)),
    "the first is not a number": (np.r_[np.nan, np.zeros(35)], range(6)),
    "the first is -1": (np.r_[-1.0, np.zeros(35)], range(6)),
    "a negative variance": (changed({(0, 0): -1e-9}), (0,)),
    "variances of -1": (changed({(k, k): -1.0 for k in range(3, 6)}), (3, 4, 5)),
    "unused axes": (changed({(k, k): 1e6 for k in (2, 3, 4)}), (2, 3, 4)),
    "unused axes of 1e12": (changed({(k, k): 1e12 for k in (2, 3, 4)}), (2, 3, 4)),
    "unused axes, correlated": (
        changed({(2, 2): 1e9, (0, 2): 3e3, (2, 0): 3e3, (5, 5): np.inf}), (2, 5),
    ),
}  # fmt: skip


@pytest.mark.parametrize("how", UNKNOWN)
def test_every_way_to_say_unknown_takes_the_configured_sigmas(how):
    covariance, axes = UNKNOWN[how]
    msg = pose(covariance=covariance)
    assert covariance_flaw(msg) == "unknown"
    of = {"unknown_position_sigma": 0.5, "unknown_attitude_sigma_deg": 0.1}
    found = pose_from_message(msg, "map", **of).covariance
    expected = COVARIANCE.diagonal().copy()
    expected[[*axes]] = (np.repeat([0.5, np.deg2rad(0.1)], 3) ** 2)[[*axes]]
    np.testing.assert_allclose(found, np.diag(expected), atol=1e-18)


@pytest.mark.parametrize("triangle", [np.triu, np.tril])
def test_one_triangle_of_a_covariance_is_all_of_it(triangle):
    whole = changed({(0, 1): 0.01, (1, 0): 0.01, (3, 5): 2e-7, (5, 3): 2e-7})
    msg = pose(covariance=triangle(whole))
    np.testing.assert_allclose(pose_from_message(msg, "map").covariance, whole, rtol=1e-12)
    assert not covariance_flaw(msg)


def test_mount_is_the_lidar_in_body_axes():
    rotation = Rotation.from_rotvec([0.1, -0.2, 0.3])
    mount = mount_from_message(transform(7, (1.0, 2.0, 3.0), rotation.as_quat()))
    assert mount.stamp_ns == 7
    np.testing.assert_array_equal(mount.position, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(mount.rotation_map_lidar, rotation.as_matrix(), atol=1e-15)
    assert not mount.covariance.any()
