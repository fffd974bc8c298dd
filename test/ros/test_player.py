# SPDX-License-Identifier: Apache-2.0
"""Playing a bag into a running node: it can be held up and loses nothing by it."""

from __future__ import annotations

import functools
import os
import pty
import subprocess
import termios

import pytest
from geometry_msgs.msg import PoseArray
from ros.conftest import status_values
from ros_scene import write_bag
from rosgraph_msgs.msg import Clock

from quadtree_lss.config.loading import load_config
from quadtree_lss.replay.bags import Bag
from quadtree_lss.replay.replay import replay
from quadtree_lss.replay.stream import ReplayError
from quadtree_lss.ros.player import PlayError, play
from quadtree_lss.ros.processes import program

pytestmark = pytest.mark.xdist_group("ros_faults")

SCANS = 12
STILL = 10  # that many equal times in a row


def test_player_says_who_is_missing(ros):
    write_bag(ros.folder / "flight", 1)
    with pytest.raises(PlayError, match="/lidar/points"):
        play(ros.folder / "flight", wait=0.2, domain_id=ros.domain)
    with pytest.raises(PlayError, match="rate"):
        play(ros.folder / "flight", rate=0.0)


def test_pause_by_keyboard_and_by_service_loses_no_scan(ros):
    bag = ros.folder / "flight"
    write_bag(bag, SCANS)
    mapping = ros.start("mapping_node")
    listener, times = ros.listen(), []
    listener.node.create_subscription(Clock, "/clock", lambda told: times.append(told.clock), 100)

    def stands():
        return len(times) > STILL and all(told == times[-1] for told in times[-STILL:])

    def runs():
        return len(times) > STILL and times[-1] != times[-STILL]

    keys, terminal = pty.openpty()
    before = termios.tcgetattr(terminal)
    command = [str(program("replay_bag")), str(bag), "--publish", "--rate", "0.2"]
    with listener:
        player = subprocess.Popen(
            command, env=ros.env, stdin=terminal, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        assert listener.wait_for(runs), "no time on /clock"
        os.write(keys, b"x ")
        assert listener.wait_for(stands), "the space bar pauses"
        for service, follows in (("toggle_paused", runs), ("pause", stands), ("resume", runs)):
            assert ros.call(listener, f"/bag_player/{service}").success
            assert listener.wait_for(follows), service
        output = player.communicate(timeout=60.0)[0].decode()
        assert player.returncode == 0 and f"{SCANS} scans" in output, output
        mapped = functools.partial(status_values, listener, "mapping_node")
        assert listener.wait_for(lambda: mapped().get("scans") == str(SCANS)), mapping.output()
    assert not [key for key in mapped() if key.startswith("scans.dropped")], mapped()
    assert termios.tcgetattr(terminal) == before, "the terminal is as it was"
    os.close(keys)
    os.close(terminal)


def test_a_bag_of_maps_is_played_into_lss_node_alone(ros):
    write_bag(ros.folder / "flight", SCANS)
    config = load_config([ros.params])
    made = replay(ros.folder / "flight", None, config, record=ros.folder / "products")
    assert len(made.assessment.sites.score)
    lss = ros.start("lss_node")
    told = []
    with ros.listen({"landing/sites": PoseArray}) as listener:  # maps have one listener: the node
        report = play(
            ros.folder / "products",
            rate=5.0,
            domain_id=ros.domain,
            progress=lambda done, total: told.append((done, total)),
        )
        assert report.maps > 1 and not report.scans and not report.poses
        final = made.cells.stamp_ns
        assert listener.wait_for(lambda: listener.stamp("landing/sites") == final), lss.output()
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
        with pytest.raises(ReplayError, match="--"):
            play(ros.folder / "flight", **limits)
    with pytest.raises(PlayError, match="rate inf"):
        play(ros.folder / "flight", rate=float("inf"))
