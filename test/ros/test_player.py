# SPDX-License-Identifier: Apache-2.0
"""Playing a bag into running nodes: the node receives all of it, with the bag's time."""

import pytest
from geometry_msgs.msg import PoseArray
from replay.recordings import KEEP_OUT, START, LandingRecorder, flight, write_ros2
from ros_scene import last_scan_ns, write_bag
from rosbags.rosbag2 import StoragePlugin, Writer
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from quadtree_lss.desk.bags.bag import Bag
from quadtree_lss.desk.player.player import PlayError, play
from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.lab.live.processes import program
from quadtree_lss.onboard.errors import OutsideInput

pytestmark = pytest.mark.xdist_group("ros_faults")

SCANS = 12


def test_player_says_who_is_missing(ros):
    bag = ros.folder / "flight.bag"  # a folder of ROS 2, whatever it is called
    write_bag(bag, 1)
    with pytest.raises(PlayError, match="/lidar/points"):
        play(bag, wait=0.2, domain_id=ros.domain)


def test_a_ros_1_bag_is_refused(tmp_path):
    with pytest.raises(PlayError, match="ROS 1 bag: replay it offline"):
        play(write_ros2(tmp_path / "flight.bag", scans=1))


@pytest.mark.slow
def test_player_names_what_is_subscribed_and_reaches_it_by_namespace_and_name(ros):
    bag = ros.folder / "flight"
    write_bag(bag, 3)
    ros.start("mapping_node", "-r", "__ns:=/lander", "-r", "nav/pose:=/ekf/pose")
    with ros.listen({"/lander/map/cells": PointCloud2}) as listener:
        listener.until(lambda: "lander/mapping_node" in listener.diagnostics)
        with pytest.raises(PlayError, match=r"/lidar/points, /nav/pose .*/ekf/pose, /lander/lidar"):
            play(bag, wait=4.0, domain_id=ros.domain)
        options = ["--namespace", "lander", "--remap", "nav/pose:=/ekf/pose", "--rate", "5"]
        done = ros.run(program("replay_bag"), bag, "--publish", *options)
        assert done.returncode == 0 and "3 scans" in done.stdout, done.stderr
        assert "deprecated" not in done.stderr + done.stdout
        listener.until_stamped(last_scan_ns(3), "/lander/map/cells")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"remap": ["lidar/point:=/x"]}, "FROM is one of lidar/points, nav/pose"),
        ({"remap": ["lidar/points"]}, "--remap"),
        ({"namespace": "no space"}, "--namespace"),
    ],
)
def test_names_that_are_none_are_refused_in_one_line(ros, options, words):
    write_bag(ros.folder / "flight", 1)
    with pytest.raises(PlayError, match=words) as caught:
        play(ros.folder / "flight", wait=0.2, domain_id=ros.domain, **options)
    assert "\n" not in str(caught.value)


def test_what_was_asked_of_landing_is_played_latched(ros):
    bag = ros.folder / "flight"
    writer = Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        recorder = LandingRecorder(writer)
        recorder.polygon("/landing/keep_out", KEEP_OUT, START)
        flight(recorder)
    ros.start("mapping_node", "-p", "mapping.max_cells:=4096")
    ros.start("lss_node")
    with ros.listen() as listener:
        told = play(bag, start=0.1, rate=2.0, domain_id=ros.domain)
        assert told.scans == 9
        listener.until(listener.has, "landing.keep_out", True, "lss_node")


def test_the_clock_runs_at_the_rate_from_the_first_message_to_the_last(ros):
    bag, times = ros.folder / "flight", []
    write_bag(bag, SCANS)
    ros.start("mapping_node")
    with ros.listen() as listener:
        hear = lambda told: times.append(told.clock.sec * 10**9 + told.clock.nanosec)  # noqa: E731
        listener.node.create_subscription(Clock, "/clock", hear, 1000)
        report = play(bag, rate=0.5, domain_id=ros.domain)
        listener.until(listener.has, "scans", SCANS)
        with Bag(bag) as source:
            listener.until(lambda: times and times[-1] == source.end_ns)
            seconds = (source.end_ns - source.start_ns) / 1e9
        values = listener.values()
    assert times == sorted(times) and len(times) > 10 and report.scans == SCANS
    assert report.duration >= 2.0 * seconds
    assert not {k: n for k, n in values.items() if k.startswith("scans.dropped") and n != "0"}


def test_a_bag_of_maps_is_played_into_lss_node_alone(ros):
    write_bag(ros.folder / "flight", SCANS)
    config = load_config([ros.params])
    made = replay(ros.folder / "flight", None, config, record=ros.folder / "products")
    assert len(made.assessment.sites.score)
    ros.start("lss_node")
    told = []
    with ros.listen({"landing/sites": PoseArray}) as listener:  # maps have one listener: the node
        how = {"rate": 5.0, "domain_id": ros.domain, "progress": lambda *done: told.append(done)}
        report = play(ros.folder / "products", **how)
        assert report.maps > 1 and not report.scans and not report.poses
        final = made.cells.stamp_ns
        listener.until_stamped(final, "landing/sites")
        poses = listener.newest["landing/sites"].poses
        sites = [(p.position.x, p.position.y) for p in poses]
    assert sites == [(x, y) for x, y, _ in made.assessment.sites.position]
    with Bag(ros.folder / "products") as bag:
        seconds = (bag.end_ns - bag.start_ns) / 1e9
    assert told and [total for _, total in told] == pytest.approx([seconds] * len(told))
    assert all(0.0 <= done <= total for done, total in told)


def test_parts_and_rates_that_make_no_sense_are_told(ros):
    write_bag(ros.folder / "flight", 1)
    for limits in ({"start": 1e9}, {"duration": float("inf")}, {"duration": 0.0}):
        with pytest.raises(OutsideInput, match="--"):
            play(ros.folder / "flight", **limits)
    for rate in (0.0, float("inf")):
        with pytest.raises(PlayError, match=f"rate {rate:g}"):
            play(ros.folder / "flight", rate=rate)
