# SPDX-License-Identifier: Apache-2.0
"""The installed examples: axes and geography by numbers, and both as processes."""

from __future__ import annotations

import importlib.util
import math
import subprocess
import sys

import numpy as np
import pytest
from geometry_msgs.msg import PointStamped, PoseStamped, PoseWithCovarianceStamped
from installed import SHARE
from rclpy.duration import Duration
from ros_scene import pose
from sensor_msgs.msg import NavSatFix

from quadtree_lss.onboard.core.geometry.rotations import exp, rotation_from_quaternion
from quadtree_lss.onboard.nodes.qos import latched
from quadtree_lss.onboard.nodes.ros_messages import header_message

pytestmark = pytest.mark.xdist_group("ros")
FOLDER = SHARE / "examples"
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])
NORTHWARD = np.array([0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)])  # x axis to the north, in ENU


def load(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


example = load("landing_target")


def test_east_north_up_becomes_north_east_down():
    place, attitude = example.local_ned([3.0, 4.0, 5.0], LEVEL)
    np.testing.assert_allclose(place, [4.0, 3.0, -5.0], atol=1e-15)
    forward, right, down = rotation_from_quaternion(attitude).T
    np.testing.assert_allclose(forward, [0.0, 1.0, 0.0], atol=1e-15)  # east
    np.testing.assert_allclose(right, [-1.0, 0.0, 0.0], atol=1e-15)  # south
    np.testing.assert_allclose(down, [0.0, 0.0, 1.0], atol=1e-15)
    _, attitude = example.local_ned([0.0, 0.0, 0.0], NORTHWARD)
    np.testing.assert_allclose(rotation_from_quaternion(attitude), np.eye(3), atol=1e-15)


def test_a_map_that_is_turned_and_an_origin_that_is_elsewhere():
    """The map's x axis points north: 3 m along it are north, 4 m along y west."""
    place, attitude = example.local_ned([13.0, 24.0, 35.0], LEVEL, 90.0, [10.0, 20.0, 30.0])
    np.testing.assert_allclose(place, [3.0, -4.0, -5.0], atol=1e-14)
    np.testing.assert_allclose(rotation_from_quaternion(attitude), np.eye(3), atol=1e-15)


def test_a_tilted_site_keeps_its_normal():
    tilt = exp([0.1, -0.2, 0.3])
    turn = np.array([0.1, -0.2, 0.3])
    angle = np.linalg.norm(turn)
    q = [*(turn / angle * math.sin(angle / 2)), math.cos(angle / 2)]
    np.testing.assert_allclose(rotation_from_quaternion(q), tilt, atol=1e-12)
    _, attitude = example.local_ned([0.0, 0.0, 0.0], q)
    east, north, up = tilt[:, 2]
    down = rotation_from_quaternion(attitude)[:, 2]
    np.testing.assert_allclose(-down, [north, east, -up], atol=1e-12)


def test_the_bodys_axes():
    """From 100 m above, looking north: 4 m north is ahead, 3 m east to the right."""
    place = [3.0, 4.0, 0.0]
    frd = example.body_frd(place, [0.0, 0.0, 100.0], NORTHWARD)
    np.testing.assert_allclose(frd, [4.0, 3.0, 100.0], atol=1e-13)
    of_frd_body = example.multiplied(NORTHWARD, example.FLU_FRD)
    frd = example.body_frd(place, [0.0, 0.0, 100.0], of_frd_body, "frd")
    np.testing.assert_allclose(frd, [4.0, 3.0, 100.0], atol=1e-13)


def cartesian(lat, lon, height):
    """Earth-centred place of latitude, longitude (degrees) and height on WGS 84."""
    a, b = 6378137.0, 6356752.314245179
    lat, lon = math.radians(lat), math.radians(lon)
    n = a * a / math.hypot(a * math.cos(lat), b * math.sin(lat))
    r = (n + height) * math.cos(lat)
    return np.array(
        [r * math.cos(lon), r * math.sin(lon), (n * b * b / (a * a) + height) * math.sin(lat)]
    )


@pytest.mark.parametrize("datum", [(47.35, 8.36, 420.0), (-33.9, 151.2, -20.0), (0.0, 179.9999, 0)])
def test_geographic_places_lie_east_north_and_up_of_the_datum(datum):
    """Checked in earth-centred axes, by another formula."""
    lat, lon = np.radians(datum[:2])
    east = np.array([-math.sin(lon), math.cos(lon), 0.0])
    up = np.array([math.cos(lat) * math.cos(lon), math.cos(lat) * math.sin(lon), math.sin(lat)])
    north = np.cross(up, east)
    for place in ([0.0, 0.0, 0.0], [3.0, 4.0, 5.0], [-800.0, 1500.0, 250.0]):
        found = cartesian(*example.geographic(place, datum)) - cartesian(*datum)
        np.testing.assert_allclose([found @ east, found @ north, found @ up], place, atol=2e-7)


def test_a_degree_at_the_equator():
    lat, lon, height = example.geographic([0.0, 1.0, 0.0], (0.0, 10.0, 0.0))
    assert lat == pytest.approx(1.0 / 110574.2758, rel=1e-6) and lon == 10.0
    lat, lon, height = example.geographic([1.0, 0.0, 0.0], (0.0, 10.0, 0.0))
    assert lon - 10.0 == pytest.approx(1.0 / 111319.4908, rel=1e-6) and lat == 0.0
    turned = example.geographic([0.0, -1.0, 0.0], (0.0, 10.0, 0.0), 90.0)
    assert turned[1] == pytest.approx(lon)


def selected(place, stamp_ns=7):
    message = PoseWithCovarianceStamped(header=header_message(stamp_ns, "map"))
    at = message.pose.pose.position
    at.x, at.y, at.z = place
    message.pose.covariance = np.diag([0.01, 0.04, 0.09, 0.0, 0.0, 0.0]).ravel()
    return message


@pytest.fixture
def run(ros):
    """Starts an example; its output is in a file."""
    processes, logs = [], []

    def start(name, *options):
        log = ros.folder / f"{name}.txt"
        command = [sys.executable, str(FOLDER / f"{name}.py"), "--ros-args", *options]
        with log.open("wb") as output:
            processes.append(
                subprocess.Popen(command, env=ros.env, stdout=output, stderr=subprocess.STDOUT)
            )
            logs.append(log)
        return log

    yield start
    for process, log in zip(processes, logs, strict=True):
        process.terminate()
        assert process.wait() == 0 and "Traceback" not in log.read_text(), log.read_text()


def publisher_of_selected(listener):
    profile = latched()
    profile.deadline = Duration(seconds=1.0)
    return listener.node.create_publisher(PoseWithCovarianceStamped, "landing/selected", profile)


def test_the_adapter_sends_while_there_is_a_target(ros, run):
    topics = {"local_ned": PoseStamped, "body_frd": PointStamped, "geographic": NavSatFix}
    seen = {name: [] for name in topics}
    with ros.listen({}) as listener:
        for name, kind in topics.items():
            topic = f"landing_target/{name}"
            listener.node.create_subscription(kind, topic, seen[name].append, 10)
        out = publisher_of_selected(listener)
        body = listener.node.create_publisher(PoseWithCovarianceStamped, "nav/pose", 10)
        log = run("landing_target", "-p", "datum:=[47.0,8.0,400.0]", "-p", "rate:=20.0")

        def say(place):
            def everything():
                out.publish(selected(place))
                body.publish(pose(9))

            return everything

        def sent():
            say((3.0, 4.0, 5.0))()
            return all(seen.values())

        assert listener.wait_for(sent), log.read_text()
        ned, frd, fix = (seen[name][-1] for name in topics)
        assert [ned.pose.position.x, ned.pose.position.y, ned.pose.position.z] == pytest.approx(
            [4.0, 3.0, -5.0]
        )
        # The scene's body looks down with x to the east: its z axis, up for FLU, points down.
        assert [frd.point.x, frd.point.y, frd.point.z] == pytest.approx([3.0, 4.0, -95.0])
        assert fix.altitude == pytest.approx(405.0, abs=1e-5)
        assert list(np.diag(fix.position_covariance.reshape(3, 3))) == pytest.approx(
            [0.01, 0.04, 0.09]
        )
        withdrawn = lambda: (say((math.nan,) * 3)(), "is withdrawn" in log.read_text())[1]  # noqa: E731
        assert listener.wait_for(withdrawn), log.read_text()
        counts = [len(messages) for messages in seen.values()]
        listener.wait_for(lambda: False, timeout=0.5)
        assert [len(messages) for messages in seen.values()] == counts
        again = lambda: (say((1.0, 1.0, 0.0))(), len(seen["local_ned"]) > counts[0] + 2)[1]  # noqa: E731
        assert listener.wait_for(again)
        silent = lambda: "is not heard of" in log.read_text()  # noqa: E731
        assert listener.wait_for(silent), "a dead lss_node is noticed"


def test_the_subscriber_follows_the_target_until_it_is_withdrawn(ros, run):
    with ros.listen({"guidance/target": PointStamped}) as listener:
        out = publisher_of_selected(listener)
        log = run("site_subscriber")
        place = lambda: listener.newest["guidance/target"].point.x  # noqa: E731

        def says(x):
            def condition():
                out.publish(selected((x, 2.0, 0.5)))
                there = "guidance/target" in listener.newest
                return there and (place() == x or math.isnan(place()) and math.isnan(x))

            return condition

        assert listener.wait_for(says(1.0)), log.read_text()
        assert "target 1.00 2.00 0.50 m, height known to 0.30 m" in log.read_text()
        assert listener.wait_for(says(math.nan)), log.read_text()
        assert listener.wait_for(says(4.0)), log.read_text()
        assert listener.wait_for(lambda: math.isnan(place())), "a dead lss_node is noticed"
