# SPDX-License-Identifier: Apache-2.0
"""A scan that misses the domain: the usual mistakes about axes and frames are recognised."""

import numpy as np
import pytest

from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.core.sensing.mount import OPTICAL_FROM_FLU
from quadtree_lss.onboard.messages.lost_points import likely_reason, misplaced, unused_points_text

DOMAIN = {"domain.xmin": -32.0, "domain.ymin": -32.0, "domain.size": 64.0}
GLIDE = np.radians(30.0)
BORESIGHT = np.array([np.cos(GLIDE), 0.0, -np.sin(GLIDE)])
RIGHT = np.array([0.0, -1.0, 0.0])
ROTATION = np.column_stack([RIGHT, np.cross(BORESIGHT, RIGHT), BORESIGHT])
"""Takes optical axes to the map's, of a lidar on a glide slope toward the east."""
PLACE = -450.0 * BORESIGHT


def optical_points(rotation=ROTATION, place=PLACE):
    """Some ground in the middle of the domain, in optical axes."""
    x, y = np.meshgrid(np.linspace(-15.0, 15.0, 12), np.linspace(-15.0, 15.0, 12))
    points_map = np.stack([x, y, 0.02 * x], axis=-1)
    return (points_map - place) @ rotation


def reason(points, rotation=ROTATION, place=PLACE, **values):
    config = config_from_values({**DOMAIN, **values})
    return likely_reason(points, Pose(0, place, rotation, np.zeros((6, 6))), config)


def test_axes_are_told():
    assert "mount.axes: flu_to_optical" in reason(optical_points() @ OPTICAL_FROM_FLU)
    flu_pose = ROTATION @ OPTICAL_FROM_FLU
    assert "mount.axes: optical_to_flu" in reason(optical_points(), flu_pose)
    wrong = {"mount.axes": "flu_to_optical"}
    turned = reason(optical_points(), ROTATION @ OPTICAL_FROM_FLU, **wrong)
    assert "mount.axes: same (100 % of its points)" in turned


def test_the_pose_of_a_level_body_is_told():
    down, place = np.diag([1.0, -1.0, -1.0]), np.array([5.0, 3.0, 80.0])
    text = reason(optical_points(down, place), np.eye(3), place)
    assert "mount.roll_deg 180" in text


def test_a_square_that_follows_is_where_the_vehicle_is():
    down, place = np.diag([1.0, -1.0, -1.0]), np.array([5.0, 3.0, 80.0])
    points, away = optical_points(down, place), place + (4000.0, -900.0, 0.0)
    assert "mount" not in reason(points, np.eye(3), away)
    values = {"domain.follow": "vehicle", "lss.grid_spacing": 0.5}
    assert "mount.roll_deg 180" in reason(points, np.eye(3), away, **values)


def test_poses_in_ned_are_told():
    ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    assert "x east, y north, z up" in reason(optical_points(), ned @ ROTATION, ned @ PLACE)


@pytest.mark.parametrize("mistake", ["ned", "no mount"])
def test_ground_above_the_lidar_is_refused_with_the_likely_reason(mistake):
    """Poses in NED and a forgotten mount, both inside of the domain: the map stays as it was."""
    config = config_from_values(DOMAIN)
    down, place = np.diag([1.0, -1.0, -1.0]), np.array([5.0, 3.0, 30.0])
    points = optical_points(down, place)
    mapper, covariance = Mapper(config), np.diag([1e-4] * 3 + [1e-8] * 3)
    assert mapper.update(points, Pose(1, place, down, covariance)).points_used == len(points) ** 2
    before = mapper.export_state()
    ned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    turn, at = (ned @ down, ned @ place) if mistake == "ned" else (np.eye(3), place)
    wrong = Pose(2, at, turn, covariance)
    report = mapper.update(points, wrong)
    assert report.points_used == 0 and report.dropped["above"] == len(points) ** 2
    assert misplaced(report)
    after = mapper.export_state()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)
    text = unused_points_text(report, mapper.domain, likely_reason(points, wrong, config))
    assert "above the lidar" in text
    assert ("x east, y north, z up" if mistake == "ned" else "mount.roll_deg 180") in text
