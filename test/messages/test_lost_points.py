# SPDX-License-Identifier: Apache-2.0
"""A scan that lies above the lidar, because of wrong axes or frames."""

import numpy as np
import pytest
from core.scenes import LOOKING_DOWN

from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose
from quadtree_lss.onboard.messages.lost_points import misplaced, unused_points_text

NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@pytest.mark.parametrize("fault", ["ned", "no mount"])
def test_ground_above_the_lidar_does_not_enter_the_map(fault):
    mapper = Mapper(
        config_from_values({"domain.xmin": -32.0, "domain.ymin": -32.0, "domain.size": 64.0})
    )
    covariance, place = np.diag([1e-4] * 3 + [1e-8] * 3), np.array([5.0, 3.0, 30.0])
    x, y = np.meshgrid(np.linspace(-15.0, 15.0, 12), np.linspace(-15.0, 15.0, 12))
    points = (np.stack([x, y, 0.02 * x], axis=-1) - place) @ LOOKING_DOWN
    assert mapper.update(points, Pose(1, place, LOOKING_DOWN, covariance)).points_used == 144
    before = mapper.export_state()
    wrong = Pose(2, place, np.eye(3), covariance)
    if fault == "ned":
        wrong = Pose(2, NED_FROM_ENU @ place, NED_FROM_ENU @ LOOKING_DOWN, covariance)
    report = mapper.update(points, wrong)
    assert report.points_used == 0 and report.dropped["above"] == 144 and misplaced(report)
    after = mapper.export_state()
    assert all(before[name].tobytes() == after[name].tobytes() for name in before)
    text = unused_points_text(report, mapper.domain)
    assert "above the lidar" in text and "run quadtree-lss doctor" in text
