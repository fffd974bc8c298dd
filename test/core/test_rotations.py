# SPDX-License-Identifier: Apache-2.0
"""SO(3) against SciPy's rotations."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from quadtree_lss.onboard.core.geometry import rotations

EXACT = 1e-12


def random_rotations(count: int, seed: int) -> Rotation:
    q = np.random.default_rng(seed).standard_normal((count, 4))
    return Rotation.from_quat(q / np.linalg.norm(q, axis=1, keepdims=True))


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-4, 0.5, 2.0, 3.1, 3.1415926, 6.0])
def test_exp_matches_scipy(angle):
    axes = np.random.default_rng(2).standard_normal((20, 3))
    vectors = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    expected = Rotation.from_rotvec(vectors).as_matrix()
    np.testing.assert_allclose(rotations.exp(vectors), expected, atol=EXACT)


@pytest.mark.parametrize("angle", [0.0, 1e-13, 1e-8, 1e-4, 0.5, 2.0, 3.1])
def test_log_undoes_exp(angle):
    axes = np.random.default_rng(3).standard_normal((20, 3))
    vectors = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    np.testing.assert_allclose(rotations.log(rotations.exp(vectors)), vectors, atol=EXACT)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (-1, 2, 3)])
def test_log_at_a_half_turn_is_an_axis_of_length_pi(axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    vector = rotations.log(2.0 * np.outer(axis, axis) - np.eye(3))
    assert np.linalg.norm(vector) == pytest.approx(np.pi, abs=1e-9)
    np.testing.assert_allclose(np.abs(vector @ axis), np.pi, atol=1e-9)


def test_matrices_of_quaternions_match_scipy():
    """Both signs and any length are one rotation."""
    r = random_rotations(200, 4)
    for factor in (1.0, -1.0, 3.0, 1e-3):
        matrices = rotations.rotation_from_quaternion(factor * r.as_quat())
        np.testing.assert_allclose(matrices, r.as_matrix(), atol=EXACT)


def test_quaternions_of_matrices_match_scipy():
    q = rotations.quaternion_from_rotation(random_rotations(500, 6).as_matrix())
    expected = random_rotations(500, 6).as_quat()
    assert (q[:, 3] >= 0.0).all()
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=EXACT)
    np.testing.assert_allclose(np.abs(np.einsum("ni,ni->n", q, expected)), 1.0, atol=EXACT)


@pytest.mark.parametrize("fraction", [0.0, 0.2, 0.5, 0.9, 1.0])
def test_slerp_matches_scipy(fraction):
    for start, end in random_rotations(40, 7).as_matrix().reshape(20, 2, 3, 3):
        expected = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([start, end])))(fraction)
        found = rotations.slerp(start, end, fraction)
        np.testing.assert_allclose(found, expected.as_matrix(), atol=1e-9)
