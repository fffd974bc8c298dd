# SPDX-License-Identifier: Apache-2.0
"""Faults on a vehicle: nodes count and report them, keep the map and continue."""

import pytest
from geometry_msgs import msg
from nav_msgs.msg import OccupancyGrid
from ros_scene import WARN, Sensors, pose
from sensor_msgs.msg import PointCloud2

from quadtree_lss.onboard.nodes.qos import latched

pytestmark = pytest.mark.xdist_group("ros_faults")

SCANS = 4
TEN_SECONDS_NS = 10**10


@pytest.fixture
def flight(ros):
    """Start a mapping node; yield listener, sensors and process."""
    mapping = ros.start("mapping_node", "-p", "pose.max_wait:=0.3")
    with ros.sensors() as (listener, sensors):
        yield listener, sensors, mapping
        mapping.check()
        assert "Traceback" not in mapping.output()


def test_poses_stop_and_resume(flight):
    listener, sensors, mapping = flight
    sensors.publish(SCANS)
    sensors.publish(SCANS, offset_ns=TEN_SECONDS_NS, make_pose=lambda stamp: None)
    listener.until(listener.has, "scans.dropped.no_pose", SCANS)
    sensors.map(SCANS, offset_ns=2 * TEN_SECONDS_NS)
    listener.until(listener.has, "scans", 2 * SCANS)
    lines = [line for line in mapping.output().splitlines() if "no longer sent" in line]
    assert len(lines) == 1, "one line for all of them"


def test_time_jumps_back_and_forward(flight):
    listener, sensors, mapping = flight
    # The second pass is a looping bag. At a jump itself scans that still wait may be dropped.
    for done, offset_ns in enumerate((TEN_SECONDS_NS, 0, 10**6 * 10**9), start=1):
        last = sensors.publish(SCANS, offset_ns=offset_ns)
        listener.until(listener.has, "scans", done * SCANS)
        listener.until_stamped(last, "map/cells", "map/observed")
    listener.until(listener.at_least, "problems.time_jump", 1)
    assert "jumped back" in mapping.output()


@pytest.mark.slow
def test_second_publisher_is_reported_without_false_losses(flight):
    listener, sensors, mapping = flight
    sensors.publish(SCANS)
    second = Sensors(listener)
    for problem in ("scan_publishers", "pose_publishers"):
        listener.until(listener.at_least, f"problems.{problem}", 1)

    def said_for_good():
        words = [f"2 publishers on {topic}" for topic in ("'/lidar/points'", "'/nav/pose'")]
        old = "new problems" not in listener.diagnostics["mapping_node"].message
        return old and listener.told("mapping_node", WARN, *words)

    listener.until(said_for_good)
    for k in (1, 2, 3):
        (sensors, second)[k % 2].publish(2, offset_ns=k * TEN_SECONDS_NS)
    listener.until(listener.has, "scans", SCANS + 6)
    assert "problems.scan_lost" not in listener.values()


def test_unused_scans_are_reported_with_the_reason(flight):
    listener, sensors, mapping = flight

    def elsewhere(stamp):
        message = pose(stamp)
        message.pose.pose.position.x += 5000.0
        return message

    sensors.publish(SCANS, make_pose=elsewhere)
    listener.until(listener.has, "problems.no_points_used", SCANS)
    lines = [line for line in mapping.output().splitlines() if "entered the map" in line]
    assert len(lines) == 1 and "4096 outside the domain" in lines[0]
    assert "x -16 ... 16" in lines[0] and "middle is at x 5000." in lines[0]


#: Topics, kinds of message of which an empty one cannot be used, who counts it, and as what.
UNUSABLE = (
    ("lidar/points", PointCloud2, "mapping_node", "cloud_empty"),
    ("nav/pose", msg.PoseWithCovarianceStamped, "mapping_node", "pose_frame"),
    ("landing/area", msg.PolygonStamped, "mapping_node", "area_frame"),
    ("landing/area", msg.PolygonStamped, "lss_node", "area_frame"),
    ("landing/keep_out", msg.PolygonStamped, "lss_node", "keep_out_frame"),
    ("landing/keep_outs", msg.PolygonInstanceStamped, "lss_node", "keep_outs_frame"),
    ("landing/target", msg.PointStamped, "lss_node", "target_frame"),
    ("landing/dispersion", msg.PoseWithCovarianceStamped, "lss_node", "dispersion_frame"),
    ("map/cells", PointCloud2, "lss_node", "map.frame"),
)


@pytest.mark.slow
def test_invalid_messages_are_counted_on_every_topic(ros):
    mapping = ros.start("mapping_node", "-p", "domain.follow:=area")
    lss = ros.start("lss_node", "-p", "frames.map:=map")
    with ros.sensors({"map/cells": PointCloud2}) as (listener, sensors):  # it would hear its own
        sensors.map(SCANS)
        listener.until(listener.at_least, "map.received", 1, "lss_node")
        observed = listener.node.create_publisher(OccupancyGrid, "map/observed", latched())
        for topic, kind, node, reason in UNUSABLE:
            sender = listener.node.create_publisher(kind, topic, latched())

            def counted(sender=sender, kind=kind, node=node, reason=reason):
                sender.publish(kind())
                observed.publish(OccupancyGrid())  # the other half of a map
                return listener.at_least(f"problems.{reason}", 1, node)

            listener.until(counted)
            listener.forget(sender)
        assert ros.call(listener, "/lss_node/land_now").message
        sensors.map(SCANS, offset_ns=TEN_SECONDS_NS)
    for process in (mapping, lss):
        assert process.stop() == 0 and "Traceback" not in process.output()
