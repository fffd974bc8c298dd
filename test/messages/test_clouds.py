# SPDX-License-Identifier: Apache-2.0
"""Every legal layout gives the same points; every illegal one a reason."""

import array

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from messages.samples import cloud, header

from quadtree_lss.onboard.core.sensing.lidar import points_from_ranges
from quadtree_lss.onboard.messages.clouds import (
    MessageError,
    layout_note,
    points_from_cloud,
    stamp_ns,
)

CONTAINERS = {
    "numpy": np.asarray,
    "bytes": lambda a: a.tobytes(),
    "bytearray": lambda a: bytearray(a.tobytes()),
    "array": lambda a: array.array("B", a.tobytes()),
    "list": lambda a: a.tolist(),
    "strided": lambda a: np.repeat(a, 2)[::2],
}


def reason_of(msg):
    with pytest.raises(MessageError) as caught:
        points_from_cloud(msg)
    text = str(caught.value)
    assert text and "\n" not in text
    return caught.value.reason


@settings(max_examples=80)
@given(
    seed=st.integers(0, 2**32 - 1),
    height=st.integers(1, 5),
    width=st.integers(1, 7),
    kinds=st.tuples(*[st.sampled_from(["f4", "f8"])] * 3),
    order=st.sampled_from("<>"),
    lead=st.integers(0, 9),
    gap=st.integers(0, 5),
    row_padding=st.integers(0, 11),
    container=st.sampled_from(sorted(CONTAINERS)),
    flat=st.booleans(),
)
def test_every_layout_gives_the_points_that_were_put_in(
    seed, height, width, kinds, order, lead, gap, row_padding, container, flat
):
    rng = np.random.default_rng(seed)
    points = rng.normal(scale=100.0, size=(height, width, 3)).astype(np.float32).astype(float)
    points[rng.random((height, width)) < 0.3] = np.nan
    layout = {"kinds": kinds, "order": order, "lead": lead, "gap": gap, "row_padding": row_padding}
    msg = cloud(points[0] if flat else points, **layout, container=CONTAINERS[container])
    decoded = points_from_cloud(msg)
    expected = points if height > 1 and not flat else points[0]
    assert decoded.dtype == ("f4" if set(kinds) == {"f4"} else "f8")
    np.testing.assert_array_equal(decoded, expected)


@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_range_azimuth_elevation_follow_equation_14(kind):
    rng = np.random.default_rng(3)
    ranges = rng.uniform(5.0, 500.0, (4, 6))
    angles = rng.uniform(-0.5, 0.5, (2, 4, 6))
    measured = np.stack([ranges, *angles], axis=-1)
    measured = measured.astype(kind).astype(float)
    names = ("range", "azimuth", "elevation")
    decoded = points_from_cloud(cloud(measured, names=names, kinds=(kind,) * 3))
    np.testing.assert_allclose(decoded, points_from_ranges(*np.moveaxis(measured, -1, 0)))
    assert (decoded[..., 2] > 0.0).all()  # z is the boresight
    np.testing.assert_allclose(np.linalg.norm(decoded, axis=-1), measured[..., 0])


def test_no_returns_stay_in_their_place():
    points = np.ones((2, 3, 3))
    points[0, 1] = np.nan
    points[1, 2] = np.inf
    decoded = points_from_cloud(cloud(points))
    missing = np.isnan(decoded).any(axis=-1)
    np.testing.assert_array_equal(missing, [[False, True, False], [False, False, True]])


@pytest.mark.parametrize("height", [1, 3])
@pytest.mark.parametrize("wrong", ["row_step 0", "row_step 4", "row_step of all", "count 0", "12"])
def test_sizes_that_a_driver_gets_wrong_leave_one_reading_which_is_told(wrong, height):
    points = np.arange(36.0).reshape(3, 4, 3).reshape(height, -1, 3)
    msg = cloud(points if height > 1 else points[0])
    assert not layout_note(msg)
    if wrong.startswith("row_step"):
        msg.row_step = {"0": 0, "4": msg.width, "all": 144}[wrong.split()[-1]]
    else:
        for field in msg.fields:
            field.count = int(wrong.removeprefix("count "))
    read = points_from_cloud(msg)
    np.testing.assert_array_equal(read.reshape(-1, 3), points.reshape(-1, 3))
    harmless = wrong == "row_step of all" and height == 1  # one row is all
    assert ("correct the driver" in layout_note(msg)) != harmless


def broken(part=lambda msg: msg, **changes):
    """A cloud of which a part, or it itself, is otherwise."""
    msg = cloud(np.ones((3, 4, 3)))
    vars(part(msg)).update(changes)
    return msg


def broken_field(**changes):
    return broken(lambda msg: msg.fields[1], **changes)


@pytest.mark.parametrize(
    ("msg", "reason"),
    [
        (broken(width=5), "size"),
        (broken(height=4), "size"),
        (broken(height=2), "size"),
        (broken(row_step=0, data=bytes(145)), "size"),
        (broken(row_step=47, data=bytes(143)), "size"),
        (broken(point_step=0), "layout"),
        (broken(point_step=4), "layout"),
        (broken(width=2**32 - 1, height=2**32 - 1), "too_large"),
        (broken(width=2**16, height=2**16), "too_large"),
        (broken(data=b""), "size"),
        (broken(data=[]), "size"),
        (broken(data=b"abc"), "size"),
        (broken(data=None), "size"),
        (broken(data=[0, 300] * 72), "size"),
        (broken(data=[0.5] * 144), "size"),
        (broken(width=0), "size"),
        (broken(fields=[]), "fields"),
        (broken(fields=broken().fields[:2]), "fields"),
        (broken(fields=broken().fields + broken().fields[:1]), "fields"),
        (broken_field(name="Y"), "fields"),
        (broken_field(datatype=5), "field_type"),
        (broken_field(datatype=0), "field_type"),
        (broken_field(count=3), "layout"),
        (broken_field(offset=9), "layout"),
        (broken_field(offset=2), "layout"),
        (broken_field(offset=2**32 - 1), "layout"),
        (broken_field(offset=-4), "layout"),
        (broken_field(datatype=8), "layout"),
    ],
)
def test_malformed_clouds_are_refused_with_a_reason(msg, reason):
    assert reason_of(msg) == reason


def test_the_wrong_byte_order_is_noticed():
    rng = np.random.default_rng(5)
    msg = cloud(rng.normal(scale=1e3, size=(400, 3)), kinds=("f8",) * 3)
    msg.is_bigendian = True
    assert reason_of(msg) == "absurd"


@given(st.integers(-(2**31), 2**31 - 1), st.integers(0, 10**9 - 1))
def test_stamps_are_exact(seconds, nanoseconds):
    head = header()
    head.stamp.sec, head.stamp.nanosec = seconds, nanoseconds
    assert stamp_ns(head) == seconds * 10**9 + nanoseconds


def test_a_stamp_with_more_than_a_second_of_nanoseconds_is_refused():
    head = header()
    head.stamp.nanosec = 10**9
    with pytest.raises(MessageError) as caught:
        stamp_ns(head)
    assert caught.value.reason == "stamp"


def test_angles_in_degrees_are_noticed():
    measured = np.column_stack([np.full(50, 10.0), np.linspace(-60, 60, 50), np.full(50, 30.0)])
    assert reason_of(cloud(measured, names=("range", "azimuth", "elevation"))) == "units"
