# SPDX-License-Identifier: Apache-2.0
"""Scanning lidars: times in every driver's layout, and a map that motion does not bend."""

from copy import copy

import numpy as np
import pytest
from messages.samples import cloud, cloud_of, pose
from scipy.spatial.transform import Rotation

from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.messages.clouds import MessageError, points_from_cloud
from quadtree_lss.onboard.messages.intake import Intake
from quadtree_lss.onboard.messages.times import offsets_from_cloud

SECOND = 1_000_000_000
STAMP = 1_700_000_000 * SECOND + 123_456_789
OFFSETS = np.linspace(0.0, 0.0999, 64)

#: Driver: field, type, values from seconds after the stamp, what float holds of them in ns.
LAYOUTS = {
    "Ouster": ("t", "u4", lambda s: np.rint(s * 1e9), 1),
    "Velodyne": ("time", "f4", lambda s: s, 8),
    "Velodyne, stamped at the end": ("time", "f4", lambda s: s - 0.0999, 8),
    "Hesai": ("timestamp", "f8", lambda s: STAMP * 1e-9 + s, 500),
    "Hesai, stamped at the end": ("timestamp", "f8", lambda s: STAMP * 1e-9 + s - 0.0999, 500),
    "Livox": ("timestamp", "f8", lambda s: STAMP + s * 1e9, 500),
    "Livox, offsets": ("offset_time", "u4", lambda s: np.rint(s * 1e9), 1),
    "offsets": ("time_offset", "f4", lambda s: s, 8),
}


@pytest.mark.parametrize("driver", LAYOUTS)
@pytest.mark.parametrize("order", "<>")
def test_each_drivers_times_are_known(driver, order):
    name, kind, values, error = LAYOUTS[driver]
    shift = -0.0999 if driver.endswith("end") else 0.0
    msg = cloud(np.ones((64, 3)), order=order, gap=2, times=(name, kind, values(OFFSETS)))
    offsets, span = offsets_from_cloud(msg, STAMP, points_from_cloud(msg))
    np.testing.assert_allclose(offsets, (OFFSETS + shift) * 1e9, atol=error)
    assert span[0] <= min(offsets.min(), 0) and span[1] >= max(offsets.max(), 0)
    np.testing.assert_allclose(span, (min(shift * 1e9, 0.0), (0.0999 + shift) * 1e9), atol=error)


UNREASONABLE = {
    "not finite": ("time", "f4", np.where(OFFSETS > 0.05, np.nan, OFFSETS)),
    "longer than a second": ("t", "u4", OFFSETS * 20e9),
    "of another clock": ("timestamp", "f8", OFFSETS + 1e6),
    "of a clock's lower half": ("t", "u4", OFFSETS * 1e9 + 1e9),
    "as shares of the scan": ("time", "f4", OFFSETS * 10.0),
    "since the epoch, rounded to 128 s": ("timestamp", "f4", STAMP * 1e-9 + OFFSETS),
}

#: Field, type, and values from seconds after the stamp.
VARIANTS = {
    "us": ("t", "u4", lambda s: np.rint(s * 1e6)),
    "us as a timestamp": ("timestamp", "u4", lambda s: np.rint(s * 1e6)),
    "us in floats": ("time", "f4", lambda s: s * 1e6),
    "ms in floats": ("time", "f4", lambda s: s * 1e3),
    "us since the epoch": ("timestamp", "f8", lambda s: STAMP * 1e-3 + s * 1e6),
    "a name with its unit": ("time_us", "u4", lambda s: np.rint(s * 1e6)),
    "another name": ("point_time_offset", "u4", lambda s: np.rint(s * 1e9)),
    "signed": ("time_offset_ns", "i4", lambda s: np.rint(s * 1e9)),
    "stamps": ("stamps", "f8", lambda s: s),
    "below zero, unsigned": ("offset_time", "u4", lambda s: np.rint((s - 0.01) * 1e9) % 2**32),
}


@pytest.mark.parametrize("period", [None, 100_000_000, 50_000_000])
@pytest.mark.parametrize("how", VARIANTS)
def test_a_unit_is_told_by_the_length_of_a_scan(how, period):
    name, kind, values = VARIANTS[how]
    msg = cloud(np.ones((64, 3)), times=(name, kind, values(OFFSETS)))
    offsets, _ = offsets_from_cloud(msg, STAMP, points_from_cloud(msg), period)
    early = 0.01 if how.startswith("below") else 0.0
    np.testing.assert_allclose(offsets, (OFFSETS - early) * 1e9, atol=1500)


@pytest.mark.parametrize("name", ["rel_t", "dt", "Time_Us", "offset_nsec"])
def test_a_field_with_another_name_holds_times_if_it_is_the_only_one(name):
    msg = cloud(np.ones((64, 3)), times=(name, "u4", np.rint(OFFSETS * 1e9)))
    offsets, *_ = offsets_from_cloud(msg, STAMP, points_from_cloud(msg))
    np.testing.assert_allclose(offsets, OFFSETS * 1e9, atol=1)
    msg.fields.append(copy(msg.fields[3]))
    msg.fields[4].name = "timestamp_high"
    with pytest.raises(MessageError, match=f"'{name}', 'timestamp_high'"):
        offsets_from_cloud(msg, STAMP, points_from_cloud(msg))


def test_a_field_of_zeros_does_not_hide_another_one():
    msg = cloud(np.ones((64, 3)), times=("time", "f4", OFFSETS))
    zeros = copy(msg.fields[3])
    msg.fields[3].name, zeros.name, zeros.offset = "timestamp", "t", 0
    msg.fields.append(zeros)  # the same for all: x
    offsets, *_ = offsets_from_cloud(msg, STAMP, points_from_cloud(msg))
    np.testing.assert_allclose(offsets, OFFSETS * 1e9, atol=8)


@pytest.mark.parametrize("length", [0.4, 0.9])
def test_slow_scans_are_known_by_their_period(length):
    seconds = np.linspace(0.0, length, 64)
    msg = cloud(np.ones((64, 3)), times=("t", "u4", np.rint(seconds * 1e9)))
    offsets, *_ = offsets_from_cloud(msg, STAMP, points_from_cloud(msg), SECOND)
    np.testing.assert_allclose(offsets, seconds * 1e9, atol=1)


@pytest.mark.parametrize("how", UNREASONABLE)
def test_unreasonable_times_are_told_and_the_scan_is_taken_as_of_one_time(how):
    intake = Intake(config_from_values({}))
    intake.on_pose(pose(STAMP))
    intake.on_cloud(cloud(np.ones((64, 3)), stamp_ns=STAMP, times=UNREASONABLE[how]), 0)
    (ready,) = intake.ready(0)
    assert ready.sweep is None and ready.points_lidar.shape == (64, 3)
    (notice,) = intake.notices()
    assert notice.reason == "times_unreasonable" and "\n" not in notice.text
    assert intake.rejected == {"times_unreasonable": 1} and not intake.dropped


VELOCITY = np.array([12.0, -5.0, -3.0])
RATE = np.array([0.3, 0.2, -0.5])  # rad/s about map axes
LINES, PER_LINE = 100, 160
ROCK = np.array([2.0, -1.0]), 1.0  # a hemisphere's place and radius


def position(t):
    return np.array([0.0, 0.0, 60.0]) + np.multiply.outer(t, VELOCITY)


def rotation(t):
    """Of the lidar, which looks down at t = 0."""
    turn = Rotation.from_rotvec(np.multiply.outer(t, RATE))
    return turn * Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))


def ranges_to_ground(origin, ray):
    """First hit (N,) of rays with the plane z = 0 or the rock on it."""
    plane = -origin[:, 2] / ray[:, 2]
    arm = origin - (*ROCK[0], 0.0)
    b = (arm * ray).sum(axis=1)
    root = b**2 - (arm**2).sum(axis=1) + ROCK[1] ** 2
    rock = np.where(root > 0.0, -b - np.sqrt(np.maximum(root, 0.0)), np.inf)
    return np.minimum(plane, rock)


def scan_lines(start):
    """Points in lidar axes and seconds from ``start``: line after line for 0.1 s."""
    across, along = np.meshgrid(np.linspace(-0.12, 0.12, PER_LINE), np.linspace(-0.1, 0.1, LINES))
    seconds = np.linspace(0.0, 0.0999, LINES * PER_LINE)
    ray = np.stack([across.ravel(), along.ravel(), np.ones(across.size)], axis=1)
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    t = start + seconds
    ranges = ranges_to_ground(position(t), rotation(t).apply(ray))
    return ray * ranges[:, None], seconds


DOMAIN = {"xmin": -16.0, "ymin": -16.0, "size": 32.0, "min_level": 5, "max_level": 7}
MAP = {"domain": DOMAIN, "lidar": {"range_noise": 0.01}}


def mapped(ready):
    mapper = Mapper(config_from_values(MAP))
    mapper.update(ready.points_lidar, ready.pose, ready.sweep)
    cells = mapper.snapshot()
    return cells, cells.measured & np.isfinite(cells.z)


#: Fields of a point as each driver sends them: name, type, byte; bytes of a point; the field of
#: times, as in `LAYOUTS`; whether a scan is an image of lines, and how it says "no return".
XYZ = [("x", "f4", 0), ("y", "f4", 4), ("z", "f4", 8)]
DRIVERS = {
    "Ouster": (
        [("intensity", "f4", 16), ("t", "u4", 20), ("reflectivity", "u2", 24), ("ring", "u2", 26),
         ("ambient", "u2", 28), ("range", "u4", 32)], 48, "Ouster", True, 0.0,
    ),
    "Velodyne": (
        [("intensity", "f4", 12), ("ring", "u2", 16), ("time", "f4", 18)], 22, "Velodyne", False,
        np.nan,
    ),
    "Velodyne, organised": (
        [("intensity", "f4", 12), ("ring", "u2", 16), ("time", "f4", 18)], 22,
        "Velodyne, stamped at the end", True, np.nan,
    ),
    "Hesai": (
        [("intensity", "f4", 12), ("ring", "u2", 16), ("timestamp", "f8", 18)], 26, "Hesai", False,
        np.nan,
    ),
    "Hesai, of PCL": (
        [("intensity", "f4", 16), ("ring", "u2", 20), ("timestamp", "f8", 24)], 32, "Hesai", False,
        np.nan,
    ),
    "Nebula": (
        [("intensity", "u1", 12), ("return_type", "u1", 13), ("channel", "u2", 14),
         ("azimuth", "f4", 16), ("elevation", "f4", 20), ("distance", "f4", 24),
         ("time_stamp", "u4", 28)], 32, "Livox, offsets", False, np.nan,
    ),
    "Livox": (
        [("intensity", "f4", 12), ("tag", "u1", 16), ("line", "u1", 17), ("timestamp", "f8", 18)],
        26, "Livox", False, 0.0,
    ),
}  # fmt: skip


def drivers_cloud(driver, points, times, stamp):
    """A cloud as it sends them; what is no coordinate and no time is one."""
    others, step, layout, image, _ = DRIVERS[driver]
    names, kinds, offsets = zip(*XYZ, *others, strict=True)
    form = {"names": names, "formats": [f"<{kind}" for kind in kinds]}
    layout_of = np.dtype({**form, "offsets": offsets, "itemsize": step})
    given = dict(zip("xyz", points.T, strict=True))
    given["time_stamp" if driver == "Nebula" else LAYOUTS[layout][0]] = times
    shape = LINES if image else 1, -1
    columns = [np.reshape(given.get(name, np.ones(len(points))), shape) for name in names]
    return cloud_of(layout_of, columns, stamp_ns=stamp)


def flown(msg, start):
    """Of an intake that heard poses at 100 Hz and one scan, taken during 0.1 s from ``start``."""
    intake = Intake(config_from_values({}))
    for k in range(30):
        t = 0.01 * k - 0.003
        turn, at = rotation(t).as_quat(), STAMP + round((t - start) * 1e9)
        intake.on_pose(pose(at, position(t), turn, 1e-9 * np.eye(6)))
    intake.on_cloud(msg, 0)
    (ready,) = intake.ready(0)
    assert not intake.rejected and not intake.notices()
    return ready


@pytest.mark.parametrize("driver", DRIVERS)
def test_a_cloud_as_its_driver_sends_it_is_read_without_a_setting(driver):
    """Points, times and de-skewing: the same scan for all of them maps the same ground."""
    _, _, layout, image, none = DRIVERS[driver]
    start, shift = 0.05, 99_900_000 if layout.endswith("end") else 0
    points, seconds = scan_lines(start)
    points[7] = none
    msg = drivers_cloud(driver, points, LAYOUTS[layout][2](seconds), STAMP + shift)
    ready = flown(msg, start)
    assert ready.stamp_ns == STAMP + shift
    assert ready.points_lidar.ndim == (3 if image else 2)
    read = ready.points_lidar.reshape(-1, 3)
    np.testing.assert_array_equal(np.delete(read, 7, 0), np.delete(points, 7, 0).astype(np.float32))
    offsets = np.delete(ready.sweep.offsets * 1e-9 + shift * 1e-9, 7)
    np.testing.assert_allclose(offsets, np.delete(seconds, 7), atol=LAYOUTS[layout][3] * 1e-9)
    cells, known = mapped(ready)
    away = np.hypot(cells.x - ROCK[0][0], cells.y - ROCK[0][1])
    ground = known & (away > ROCK[1] + cells.size)
    assert ground.sum() > 50 and np.abs(cells.z[ground]).max() < 0.01
    assert cells.normal[ground, 2].min() > np.cos(0.01)
    top = known & (away < 0.4) & (cells.size < 0.6)
    assert cells.z[top].max() == pytest.approx(ROCK[1], abs=0.1)
