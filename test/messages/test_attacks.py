# SPDX-License-Identifier: Apache-2.0
"""Text from outside, whoever sent it, is shown as one short line."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from fuzz.cases import FRAMES, random_transform
from messages import samples

from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages.intake import Intake


@pytest.mark.parametrize("frame", FRAMES[3:])
def test_a_frame_from_outside_is_told_in_one_short_line(frame):
    intake = Intake(config_from_values({}))
    intake.on_pose(samples.pose(frame=frame))
    (notice,) = intake.notices()
    assert notice.reason == "pose_frame"
    assert notice.text.isprintable() and len(notice.text) < 400
    assert "expected 'map' (parameter frames.map)" in notice.text


@pytest.mark.parametrize("text", [*FRAMES, "a\tb\r\nc", "caf\u00e9 \u2026", "\ud800", "\x00"])
def test_text_from_outside_is_one_printable_line(text):
    line = one_line(text, 100)
    assert line.isprintable() and "\n" not in line and len(line) < 140
    assert line == text or not text.isprintable() or len(text) > 100


@pytest.mark.parametrize("frame", [*FRAMES[3:5], "m" * 500, FRAMES[5]])
def test_frames_of_bodies_and_transforms_are_as_short(frame):
    intake = Intake(config_from_values({"mount.tf": True, "frames.body": "body"}))
    odometry = samples.pose()
    odometry.child_frame_id = frame
    intake.on_pose(odometry)
    cloud = samples.cloud(np.ones((2, 3)), stamp_ns=10**9)
    cloud.header.frame_id = frame
    intake.on_cloud(cloud, 0)
    transform = random_transform(np.random.default_rng(3), 0)
    transform.header.frame_id = frame
    transform.transform.rotation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    transform.transform.translation = SimpleNamespace(x=0.0, y=0.0, z=0.0)
    transform.header.stamp.nanosec = 0
    intake.on_transforms(SimpleNamespace(transforms=[transform]))
    intake.finish()
    notices = intake.notices()
    assert len(notices) >= 2
    for _, text in notices:
        assert text.isprintable() and max(map(len, text.split("'"))) < 150
