# SPDX-License-Identifier: Apache-2.0
"""Clouds and poses made to break the decoder: each is taken soundly or counted by its reason."""

from __future__ import annotations

import array
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from messages import samples

from quadtree_lss.onboard.config.settings import Config, config_from_values
from quadtree_lss.onboard.errors import one_line
from quadtree_lss.onboard.messages.clouds import MAX_DISTANCE, points_from_cloud
from quadtree_lss.onboard.messages.intake import Intake
from quadtree_lss.onboard.messages.poses import MAX_POSITION

WHOLE = [0, 1, 2, 3, 4, 7, 8, 12, 16, 255, 2**16, 2**22, 2**22 + 1, 2**31 - 1, 2**31, 2**32 - 1]
NUMBERS = [0.0, -0.0, 1.0, -1.0, 1e-300, 1e300, 1e8, 1e9, math.inf, -math.inf, math.nan, 2.0**0.5]
NAMES = ["x", "y", "z", "t", "time", "range", "azimuth", "elevation", "", "x\n\x1b[2J", "q" * 10**5]
FRAMES = ["map", "/map", "", "odom\nERROR all is well", "\x1b]0;title\x07", "m" * 10**6, "\u202e"]
CONTAINERS = [np.asarray, bytes, lambda data: array.array("B", bytes(data))]
KINDS = [("f4",) * 3, ("f8",) * 3, ("f4", "f8", "f4")]


def one_of(rng: np.random.Generator, among: Sequence[Any]) -> Any:
    return among[rng.integers(len(among))]


@np.errstate(over="ignore", invalid="ignore")  # what is written may not fit its type
def random_cloud(rng: np.random.Generator) -> SimpleNamespace:
    """A well-formed cloud with up to two of its parts spoilt."""
    shape = (int(rng.integers(1, 5)), int(rng.integers(1, 6)), 3)
    points = rng.normal(scale=one_of(rng, [1.0, 100.0, 1e7]), size=shape)
    points[rng.random(shape) < 0.1] = one_of(rng, NUMBERS)
    names = ("x", "y", "z") if rng.random() < 0.7 else ("range", "azimuth", "elevation")
    times = None
    if rng.random() < 0.3:
        kind = one_of(rng, ["u4", "i4", "f4", "f8"])
        late = one_of(rng, [0.0, 1.0, 1e8, 1e18]) * rng.random(shape[:2])
        times = (one_of(rng, ["t", "time", "timestamp"]), kind, late.astype(kind))
    cloud = samples.cloud(
        points,
        names=names,
        kinds=one_of(rng, KINDS),
        order=one_of(rng, ["<", ">"]),
        lead=int(rng.integers(0, 4)),
        gap=int(rng.integers(0, 5)),
        row_padding=int(rng.integers(0, 9)),
        stamp_ns=int(rng.integers(0, 2**31)) * 10**9,
        container=one_of(rng, CONTAINERS),
        times=times,
    )
    for _ in range(rng.integers(0, 3)):
        spoil_cloud(cloud, rng)
    return cloud


def spoil_cloud(cloud: SimpleNamespace, rng: np.random.Generator) -> None:
    """One part of a cloud becomes something that no driver should send."""
    which = rng.integers(7)
    if which == 0:
        name = one_of(rng, ["height", "width", "point_step", "row_step"])
        setattr(cloud, name, one_of(rng, WHOLE))
    elif which == 1:
        cloud.is_bigendian = not cloud.is_bigendian
    elif which == 2:
        data = bytes(cloud.data)
        end = int(rng.integers(0, len(data) + 1))
        cloud.data = data[:end] + bytes(rng.integers(0, 256, rng.integers(0, 9), dtype=np.uint8))
    elif which == 3:
        cloud.data = rng.integers(0, 256, len(cloud.data), dtype=np.uint8)
    elif which == 4 and cloud.fields:
        field = cloud.fields[rng.integers(len(cloud.fields))]
        field.name = one_of(rng, NAMES)
    elif which == 5 and cloud.fields:
        field = cloud.fields[rng.integers(len(cloud.fields))]
        name = one_of(rng, ["offset", "datatype", "count"])
        setattr(field, name, one_of(rng, WHOLE))
    elif cloud.fields:
        place = int(rng.integers(len(cloud.fields)))
        cloud.fields = cloud.fields[:place] + cloud.fields[place + rng.integers(2) :] * 2
    cloud.header.stamp.nanosec = one_of(rng, [0, 999_999_999, 2**32 - 1])


def random_pose(rng: np.random.Generator) -> SimpleNamespace:
    """A well-formed pose with up to three of its parts spoilt."""
    turn = rng.normal(size=4)
    root = rng.normal(size=(6, 6)) * one_of(rng, [1e-6, 1.0, 1e4])
    pose = samples.pose(
        stamp_ns=int(rng.integers(0, 2**31)) * 10**9 + int(rng.integers(10**9)),
        position=rng.normal(scale=1e3, size=3),
        xyzw=turn / np.linalg.norm(turn),
        covariance=root @ root.T,
    )
    for _ in range(rng.integers(0, 4)):
        which, value = rng.integers(6), one_of(rng, NUMBERS)
        held = pose.pose
        if which == 0:
            setattr(held.pose.position, "xyz"[rng.integers(3)], value)
        elif which == 1:
            setattr(held.pose.orientation, "xyzw"[rng.integers(4)], value)
        elif which == 2 and len(held.covariance) == 36:
            held.covariance[rng.integers(36)] = value
        elif which == 3:
            held.covariance = np.full(one_of(rng, [0, 35, 36, 37]), value)
        elif which == 4:
            pose.header.frame_id = one_of(rng, FRAMES)
        else:
            pose.header.stamp.nanosec = one_of(rng, [10**9, 2**32 - 1])
    return pose


def attack(seed: int, count: int) -> None:
    """As many clouds and half as many poses through the decoder of node and replay."""
    rng = np.random.default_rng(seed)
    intake = Intake(Config())
    for k in range(count):
        if k % 50 == 0:
            intake.ready(k * 10**9)
        take_cloud(intake, random_cloud(rng), k * 10**7)
        if k % 2:
            take_pose(intake, random_pose(rng))
    assert intake.scans > count // 5 and intake.poses_taken > count // 20
    assert len(intake.rejected) > 12, "the attacks are of many kinds"
    told = sum(n for key, n in intake.rejected.items() if key.startswith("cloud_"))
    assert intake.scans + told == count


def take_cloud(intake: Intake, cloud: SimpleNamespace, now_ns: int) -> None:
    with np.errstate(all="raise", under="ignore"):
        taken = intake.on_cloud(cloud, now_ns)
    notices = intake.notices()
    assert all(len(text) < 1100 and text.isprintable() for _, text in notices)
    if taken is None:
        assert notices
        return
    points = points_from_cloud(cloud)
    assert points.shape[-1] == 3 and points.size == 3 * cloud.width * cloud.height
    there = points[~np.isnan(points)]
    assert (np.abs(there) <= MAX_DISTANCE).all()


def take_pose(intake: Intake, pose: SimpleNamespace) -> None:
    before = intake.poses_taken
    with np.errstate(all="raise", under="ignore"):
        intake.on_pose(pose)
    notices = intake.notices()
    assert all(len(text) < 1100 and text.isprintable() for _, text in notices)
    if intake.poses_taken == before:
        assert notices
        return
    held = intake.queue.poses.at(pose.header.stamp.sec * 10**9 + pose.header.stamp.nanosec)
    assert (np.abs(held.position) <= MAX_POSITION).all()
    np.testing.assert_allclose(
        held.rotation_map_lidar @ held.rotation_map_lidar.T, np.eye(3), atol=1e-9
    )
    assert np.isfinite(held.covariance).all()
    scale = np.sqrt(np.maximum(np.diagonal(held.covariance), 1e-300))
    scaled = held.covariance / np.outer(scale, scale)
    assert np.linalg.eigvalsh(0.5 * (scaled + scaled.T)).min() > -1e-5


def test_no_cloud_and_no_pose_breaks_the_decoder():
    attack(seed=1, count=20_000)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 12))
def test_none_of_a_million_breaks_it(seed):
    attack(seed, count=100_000)


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
