# SPDX-License-Identifier: Apache-2.0
"""Where the lidar flies and looks, and what the navigation makes of it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadtree_lss.lab.simulation.trajectory import (
    Sweep,
    WhiteNavigation,
    look_at,
    section_vi_trajectory,
)


def test_section_vi_end_conditions():
    trajectory = section_vi_trajectory()
    velocity = trajectory.position.derivative()
    np.testing.assert_allclose(trajectory.position(0.0), [100.0, -100.0, 500.0])
    np.testing.assert_allclose(velocity(0.0), [-5.0, -5.0, -5.0])
    np.testing.assert_allclose(trajectory.position(60.0), [0.0, 0.0, 20.0], atol=1e-9)
    np.testing.assert_allclose(velocity(60.0), 0.0, atol=1e-9)
    # A cubic: its third derivative is constant.
    third = trajectory.position.derivative(3)(np.linspace(0.0, 60.0, 7))
    np.testing.assert_allclose(third, np.broadcast_to(third[0], third.shape))


def test_look_at_is_an_upright_optical_frame():
    generator = np.random.default_rng(1)
    positions = generator.normal(0.0, 50.0, (200, 3)) + [0.0, 0.0, 300.0]
    targets = generator.normal(0.0, 20.0, (200, 3))
    rotations = look_at(positions, targets)
    identity = np.broadcast_to(np.eye(3), rotations.shape)
    np.testing.assert_allclose(rotations @ rotations.transpose(0, 2, 1), identity, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(rotations), 1.0)
    np.testing.assert_allclose(rotations[:, 2, 0], 0.0, atol=1e-12)  # x level
    assert np.all(rotations[:, 2, 1] < 0.0)  # y down


@pytest.mark.parametrize(("half", "duration", "reverse"), [(30.0, 20.0, False), (10.0, 2.0, True)])
def test_sweep_covers_its_box_with_margin(half, duration, reverse):
    sweep = Sweep((0.0, 0.0, 0.0), half, half, duration, 1.0, reverse=reverse)
    times = np.arange(0.0, duration, 0.05)
    positions, rotations = sweep.trajectory().poses(times)
    assert np.linalg.norm(positions[0]) == pytest.approx(450.0)
    assert np.degrees(np.arcsin(positions[0, 2] / 450.0)) == pytest.approx(30.0)
    # A point is seen if both its angles are within half a degree of the boresight.
    axis = np.linspace(-half - 1.9, half + 1.9, 60)
    ground = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    ground = np.column_stack([ground, np.zeros(len(ground))])
    times_seen = np.zeros(len(ground), int)
    for position, rotation in zip(positions, rotations, strict=True):
        local = (ground - position) @ rotation
        angles = np.degrees(np.arctan2(local[:, :2], local[:, 2:]))
        times_seen += np.all(np.abs(angles) < 0.5, axis=1)
    assert times_seen.min() >= 1


def _errors(estimate, positions, rotations):
    tilt = Rotation.from_matrix(estimate.rotations @ rotations.transpose(0, 2, 1)).as_rotvec()
    return np.hstack([estimate.positions - positions, tilt])


def _truth(count, generator):
    positions = generator.normal(0.0, 100.0, (count, 3))
    return positions, Rotation.from_quat(generator.normal(size=(count, 4))).as_matrix()


def test_white_navigation_has_the_covariance_it_claims():
    generator = np.random.default_rng(2)
    positions, rotations = _truth(20_000, generator)
    estimate = WhiteNavigation().estimate(generator, np.arange(20_000.0), positions, rotations)
    errors = _errors(estimate, positions, rotations)
    sigma = np.sqrt(np.diag(estimate.covariance))
    np.testing.assert_allclose(sigma, [0.5] * 3 + [np.radians(0.01)] * 3)
    normalised = errors / sigma
    np.testing.assert_allclose(normalised.T @ normalised / len(errors), np.eye(6), atol=0.05)
    assert np.abs((normalised[1:] * normalised[:-1]).mean(axis=0)).max() < 0.03
