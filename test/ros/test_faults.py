# SPDX-License-Identifier: Apache-2.0
"""What goes wrong on a vehicle: nodes count it, say so, keep the map and go on."""

from __future__ import annotations

import functools
from array import array

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from ros.conftest import at_least, has, status_values
from ros_scene import Sensors, cloud, gimbal, level_body, pose
from sensor_msgs.msg import PointField

from quadtree_lss.onboard.nodes.qos import stream

pytestmark = pytest.mark.xdist_group("ros_faults")

SCANS = 4
TEN_SECONDS_NS = 10**10


def stamped_both(listener, stamp_ns):
    """True if the newest messages of the map have this stamp."""
    return all(listener.stamp(topic) == stamp_ns for topic in ("map/cells", "map/observed"))


@pytest.fixture
def flight(ros):
    """A mapping node with sensors: listener, sensors, process."""
    mapping = ros.start("mapping_node", "-p", "pose.max_wait:=0.3")
    with ros.listen() as listener:
        sensors = Sensors(listener).matched()
        yield listener, sensors, mapping
        mapping.check()
        assert "Traceback" not in mapping.output()


@pytest.mark.survives(
    "poses stop",
    "scans wait `pose.max_wait` and are dropped with a line that says so; goes on by itself",
)
def test_poses_stop_and_resume(flight):
    listener, sensors, mapping = flight
    sensors.publish(SCANS)
    sensors.publish(SCANS, offset_ns=TEN_SECONDS_NS, make_pose=lambda stamp: None)
    dropped = functools.partial(has, listener, "scans.dropped.no_pose", SCANS)
    assert listener.wait_for(dropped), mapping.output()
    sensors.map(mapping, SCANS, offset_ns=2 * TEN_SECONDS_NS)
    assert listener.wait_for(lambda: has(listener, "scans", 2 * SCANS))
    lines = [line for line in mapping.output().splitlines() if "no longer sent" in line]
    assert len(lines) == 1, "one line for all of them"


def test_poses_out_of_order_serve_as_well(flight):
    listener, sensors, mapping = flight
    first, late = [], []

    def two_at_a_time(stamp):
        """The later of two comes first; the very first in time, or all before it are too old."""
        if not first:
            first.append(stamp)
            return pose(stamp)
        late.append(pose(stamp))
        return [late.pop(), late.pop()] if len(late) == 2 else None

    sensors.publish(SCANS, make_pose=two_at_a_time)
    enough = functools.partial(at_least, listener, "scans", SCANS - 1)  # the last may lack one
    assert listener.wait_for(enough), mapping.output()
    assert not any(
        key.startswith("problems.pose") for key in status_values(listener, "mapping_node")
    )


@pytest.mark.survives(
    "time jumps back by more than 1 s, or forward",
    "buffers are cleared, the map is kept, its stamp follows",
)
def test_time_jumps_back_and_forward(flight):
    listener, sensors, mapping = flight
    # The second pass is a looping bag. At a jump itself scans that still wait may be dropped.
    for done, offset_ns in enumerate((TEN_SECONDS_NS, 0, 10**6 * 10**9), start=1):
        last = sensors.publish(SCANS, offset_ns=offset_ns)
        mapped = functools.partial(has, listener, "scans", done * SCANS)
        assert listener.wait_for(mapped), mapping.output()
        stamped = functools.partial(stamped_both, listener, last)
        assert listener.wait_for(stamped), "the map's stamp follows"
    assert listener.wait_for(lambda: at_least(listener, "problems.time_jump", 1))
    assert "jumped back" in mapping.output()


@pytest.mark.survives(
    "covariance all zero",
    "unknown by convention: `pose.unknown_*` are used, with a line at most every five seconds",
)
def test_unknown_and_invalid_covariances(flight):
    listener, sensors, mapping = flight

    def unknown(stamp):
        message = pose(stamp)
        message.pose.covariance = np.zeros(36)
        return message

    def invalid(stamp):
        message = pose(stamp)
        message.pose.covariance[1] = 5.0
        return [message, pose(stamp)]

    sensors.publish(SCANS, make_pose=unknown)
    sensors.map(mapping, SCANS, offset_ns=TEN_SECONDS_NS, make_pose=invalid)
    for key in ("pose_covariance_unknown", "pose_covariance"):
        told = functools.partial(at_least, listener, f"problems.{key}", SCANS)
        assert listener.wait_for(told), key


def packed(stamp_ns, columns, names, *, kind="<f4", height=1, step=None, row_pad=0):
    """Cloud of columns (N, 3) with padded points and rows."""
    dtype, width = np.dtype(kind), len(columns) // height
    step = step or 3 * dtype.itemsize
    message = cloud(stamp_ns, np.zeros((1, 1, 3)))
    message.height, message.width, message.point_step = height, width, step
    message.row_step = width * step + row_pad
    code = PointField.FLOAT32 if dtype.itemsize == 4 else PointField.FLOAT64
    message.fields = [
        PointField(name=name, offset=k * dtype.itemsize, datatype=code, count=1)
        for k, name in enumerate(names)
    ]
    raw = np.zeros((height, message.row_step), np.uint8)
    points = np.zeros((len(columns), step), np.uint8)
    points[:, : 3 * dtype.itemsize] = columns.astype(kind).view(np.uint8).reshape(len(columns), -1)
    raw[:, : width * step] = points.reshape(height, -1)
    message.data = array("B", raw.tobytes())
    message.is_bigendian = kind.startswith(">")
    return message


def layouts(stamp_ns, points):
    """The same scan in legal layouts; the stamp tells which."""
    flat, rows = points.reshape(-1, 3), len(points)
    distance = np.linalg.norm(flat, axis=1)
    azimuth = np.arctan2(flat[:, 0], flat[:, 2])
    elevation = np.arcsin(-flat[:, 1] / distance)
    angles = np.column_stack([distance, azimuth, elevation])
    xyz, spherical = ("x", "y", "z"), ("range", "azimuth", "elevation")
    made = (
        lambda t: packed(t, flat, xyz, kind="<f8"),
        lambda t: packed(t, flat, xyz, kind=">f4", height=rows, step=32, row_pad=5),
        lambda t: packed(t, angles, spherical, kind=">f8", height=rows),
        lambda t: packed(t, flat[:, ::-1], ("z", "y", "x"), step=13),
    )
    return made[(stamp_ns // 100_000_000) % len(made)](stamp_ns)


def test_every_legal_layout_maps_all_points(flight):
    listener, sensors, mapping = flight
    sensors.map(mapping, SCANS, make_cloud=layouts)
    assert listener.wait_for(lambda: has(listener, "scans", SCANS)), mapping.output()
    values = status_values(listener, "mapping_node")
    dropped = {key: value for key, value in values.items() if key.startswith("points.dropped")}
    assert set(dropped.values()) == {"0"}, dropped


@pytest.mark.survives(
    "two publishers of scans, poses or maps",
    "a warning; all are taken; lost scans cannot be seen then",
)
def test_a_second_publisher_is_told_and_no_loss_invented(flight):
    listener, sensors, mapping = flight
    sensors.publish(SCANS)
    second = Sensors(listener)
    for problem in ("scan_publishers", "pose_publishers"):
        told = functools.partial(at_least, listener, f"problems.{problem}", 1)
        assert listener.wait_for(told), mapping.output()
    for k in (1, 2, 3):
        (sensors, second)[k % 2].publish(2, offset_ns=k * TEN_SECONDS_NS)
    total = functools.partial(has, listener, "scans", SCANS + 6)
    assert listener.wait_for(total), mapping.output()
    assert "problems.scan_lost" not in status_values(listener, "mapping_node")


@pytest.mark.parametrize("moving", [False, True])
def test_mounts_give_the_map_of_the_lidars_own_poses(ros, moving):
    own = ros.start("mapping_node")
    with ros.listen() as listener:
        sensors = Sensors(listener).matched()
        last = sensors.publish(SCANS)
        assert listener.wait_for(lambda: listener.stamp("map/observed") == last), own.output()
        wanted = np.frombuffer(listener.newest["map/observed"].data, np.int8)
    own.stop()
    static = ("-p", "mount.z:=-2.0", "-p", "mount.roll_deg:=180.0")
    mapping = ros.start("mapping_node", *(("-p", "mount.gimbal:=true") if moving else static))
    with ros.listen() as listener:
        sensors = Sensors(listener)
        publisher = listener.node.create_publisher(
            TransformStamped, "lidar/gimbal", stream(100, reliable=True)
        )
        sensors.matched()
        assert publisher.get_subscription_count() == int(moving)

        def on_pose(stamp):
            if moving:
                publisher.publish(gimbal(stamp, (0.0, 0.0, -2.0)))

        body = functools.partial(level_body, above=2.0)
        last = sensors.publish(SCANS, make_pose=body, on_pose=on_pose)
        assert listener.wait_for(lambda: listener.stamp("map/observed") == last), mapping.output()
        found = np.frombuffer(listener.newest["map/observed"].data, np.int8)
    assert (found != wanted).mean() < 1e-3


@pytest.mark.survives(
    "no point of a scan enters the map",
    "`problems.no_points_used`, one line in five seconds: how many were outside the domain, out of "
    "range, isolated or no returns, and where the scan lies",
)
def test_scans_of_which_nothing_enters_the_map_are_told_with_the_reason(flight):
    listener, sensors, mapping = flight

    def elsewhere(stamp):
        message = pose(stamp)
        message.pose.pose.position.x += 5000.0
        return message

    sensors.publish(SCANS, make_pose=elsewhere)
    told = functools.partial(has, listener, "problems.no_points_used", SCANS)
    assert listener.wait_for(told), mapping.output()
    lines = [line for line in mapping.output().splitlines() if "entered the map" in line]
    assert len(lines) == 1 and "4096 outside the domain" in lines[0]
    assert "x -16 ... 16" in lines[0] and "middle is at x 5000." in lines[0]


def test_a_missing_gimbal_is_told_by_its_name_and_topic(ros):
    args = ("-p", "mount.gimbal:=true", "-p", "pose.max_wait:=0.2", "-r", "lidar/gimbal:=/my/turn")
    mapping = ros.start("mapping_node", *args)
    with ros.listen() as listener:
        sensors = Sensors(listener).matched()
        sensors.publish(SCANS)
        told = functools.partial(has, listener, "scans.dropped.gimbal_no_pose", SCANS)
        assert listener.wait_for(told), mapping.output()
    assert "no gimbal angle has arrived on '/my/turn'" in mapping.output()
