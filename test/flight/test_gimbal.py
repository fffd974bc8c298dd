# SPDX-License-Identifier: Apache-2.0
"""The lidar sees all of the candidate area in its first pass, and turns no faster than it can."""

import numpy as np
import pytest

from quadtree_lss.lab.flight.gimbal import Gimbal, ScanPlan

DT = 0.01


@pytest.mark.parametrize("heading", [0.0, 0.6, 2.0])
def test_the_first_pass_covers_the_area(heading):
    half, field_of_view = 25.0, 1.0
    back = np.array([-np.cos(heading), -np.sin(heading)])
    gimbal = Gimbal(ScanPlan(), field_of_view, np.zeros(3), half)
    seen = np.zeros((50, 50), dtype=int)
    x, y = np.meshgrid(np.arange(-24.5, 25.0), np.arange(-24.5, 25.0))
    turns, last = [], None
    for k in range(800):
        position = np.array([*(520.0 - 0.3 * k) * back, 300.0 - 0.16 * k])
        velocity = np.array([*-30.0 * back, -16.0])
        gimbal.step(k * DT, position, velocity, None, DT)
        if last is not None:
            turns.append(np.degrees(np.arccos(np.clip(last @ gimbal.boresight, -1.0, 1.0))))
        last = gimbal.boresight
        if k % 5 == 0:
            rays = np.stack([x, y, 0.0 * x], axis=-1) - position
            across, down, ahead = np.moveaxis(rays @ gimbal.rotation(), -1, 0)
            edge = np.tan(np.radians(0.5 * field_of_view))
            seen += (np.abs(across) <= edge * ahead) & (np.abs(down) <= edge * ahead)
    assert gimbal.passes == 1
    assert max(turns) <= ScanPlan().rate_deg * DT + 1e-6
    assert (seen > 0).mean() > 0.95 and np.median(seen) >= 3
