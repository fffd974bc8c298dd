# SPDX-License-Identifier: Apache-2.0
"""Playing a bag into running nodes, which receive all messages with the bag's time."""

import pytest
from replay.recordings import KEEP_OUT, START, LandingRecorder, flight
from ros_scene import last_scan_ns, write_bag
from rosbags.rosbag2 import StoragePlugin, Writer
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import PointCloud2

from quadtree_lss.desk.bags.bag import Bag
from quadtree_lss.desk.player.player import PlayError, play, played_topics
from quadtree_lss.desk.replay.stream import Part
from quadtree_lss.lab.live.processes import program

pytestmark = pytest.mark.xdist_group("ros_faults")

SCANS = 12


def play_bag(path, start=0.0, **how):
    with Bag(path) as bag:
        return play(bag, played_topics(bag), Part.of(bag, start), **how)


def test_player_names_missing_subscribers(ros):
    bag = ros.folder / "flight.bag"  # a folder of ROS 2, whatever it is called
    write_bag(bag, 1)
    with pytest.raises(PlayError, match="/lidar/points"):
        play_bag(bag, wait=0.2)


@pytest.mark.slow
def test_player_names_what_is_subscribed_and_reaches_it_by_namespace_and_name(ros):
    bag = ros.folder / "flight"
    write_bag(bag, 3)
    ros.start("mapping_node", "-r", "__ns:=/lander", "-r", "nav/pose:=/ekf/pose")
    with ros.listen({"/lander/map/cells": PointCloud2}) as listener:
        listener.until(lambda: "lander/mapping_node" in listener.diagnostics)
        with pytest.raises(PlayError, match=r"/lidar/points, /nav/pose .*/ekf/pose, /lander/lidar"):
            play_bag(bag, wait=4.0)
        options = ["--namespace", "lander", "--remap", "nav/pose:=/ekf/pose", "--rate", "5"]
        done = ros.run(program("replay_bag"), bag, "--publish", *options)
        assert done.returncode == 0 and "3 scans" in done.stdout, done.stderr
        assert "deprecated" not in done.stderr + done.stdout
        listener.until_stamped(last_scan_ns(3), "/lander/map/cells")


def test_landing_inputs_are_played_latched(ros):
    bag = ros.folder / "flight"
    writer = Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        recorder = LandingRecorder(writer)
        recorder.polygon("/landing/keep_out", KEEP_OUT, START)
        flight(recorder)
    ros.start("mapping_node", "-p", "mapping.max_cells:=4096")
    ros.start("lss_node")
    with ros.listen() as listener:
        told = play_bag(bag, start=0.1, rate=2.0)
        assert told.scans == 9
        listener.until(listener.has, "landing.keep_out", True, "lss_node")


@pytest.mark.slow
def test_the_clock_runs_at_the_rate_from_the_first_message_to_the_last(ros):
    bag, times = ros.folder / "flight", []
    write_bag(bag, SCANS)
    ros.start("mapping_node")
    with ros.listen() as listener:
        hear = lambda told: times.append(told.clock.sec * 10**9 + told.clock.nanosec)  # noqa: E731
        listener.node.create_subscription(Clock, "/clock", hear, 1000)
        report = play_bag(bag, rate=0.5)
        listener.until(listener.has, "scans", SCANS)
        with Bag(bag) as source:
            listener.until(lambda: times and times[-1] == source.end_ns)
            seconds = (source.end_ns - source.start_ns) / 1e9
        values = listener.values()
    assert times == sorted(times) and len(times) > 10 and report.scans == SCANS
    assert report.duration >= 2.0 * seconds
    assert not {k: n for k, n in values.items() if k.startswith("scans.dropped") and n != "0"}
