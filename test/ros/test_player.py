# SPDX-License-Identifier: Apache-2.0
"""Playing a bag into a running node: it can be held up and loses nothing by it."""

from __future__ import annotations

import functools
import os
import pty
import subprocess
import termios

import pytest
from ros.conftest import status_values
from ros_scene import write_bag
from rosgraph_msgs.msg import Clock

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
