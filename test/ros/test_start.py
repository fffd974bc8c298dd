# SPDX-License-Identifier: Apache-2.0
"""Log lines of nodes at the start, at the first success, and of lasting states."""

import sys
from importlib import metadata

import numpy as np
import pytest
from packaging.requirements import Requirement
from ros_scene import cloud, last_scan_ns, pose
from rosgraph_msgs.msg import Clock

import quadtree_lss
from quadtree_lss import build
from quadtree_lss.onboard.nodes.qos import stream
from quadtree_lss.onboard.nodes.ros_messages import time_message

pytestmark = pytest.mark.xdist_group("ros")


def test_start_and_first_success_are_one_line_each(ros):
    mapping = ros.start("mapping_node", "-p", "lidar.max_range:=900", "-r", "nav/pose:=/ekf/pose")
    lss = ros.start("lss_node", "-r", "__ns:=/lander", "-r", "map/cells:=/map/cells")
    with ros.listen() as listener:
        listener.until(lambda: all("vehicle of" in node.output() for node in (lss, mapping)))
        lines = [line for line in mapping.output().splitlines() if "waiting for" not in line]
        assert len(lines) == 1
        for words in (
            f"quadtree_lss {quadtree_lss.__version__} ({build.name()})",
            "lidar.range_noise=0.03, lss.grid_spacing=0.5, lss.sites=3, ",
            f"publish.rate=11.0, diagnostics.warn_age=5.0 (from {ros.params})",
            "lidar.max_range=900.0 (from command line)",
            "domain x -16 ... 16, y -16 ... 16 m in frame 'map', cells 4 ... 0.5 m",
            "vehicle of 3.7 m diameter, margin 0 m",
        ):
            assert words in lines[0], words


def test_first_scan_and_first_sites_are_logged_once(ros):
    mapping, lss = ros.start("mapping_node"), ros.start("lss_node")
    with ros.sensors() as (listener, sensors):
        sensors.publish(4)
        listener.until(lambda: "first sites: 3, the best at x " in lss.output())
        sensors.publish(4, offset_ns=2_000_000_000)
        listener.until(listener.at_least, "scans", 8)
    assert mapping.output().count("first scan mapped: 1700000000.000000 s, ") == 1
    assert lss.output().count("first sites") == 1


HELD_UP = """
import os, sys, time
class Late:
    def find_spec(self, name, path=None, target=None):
        while name == {module!r} and not os.path.exists({go!r}):
            time.sleep(0.05)
sys.meta_path.insert(0, Late())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "module", "what"),
    [
        ("mapping_node", "rclpy.node", "its modules"),
        ("lss_node", "quadtree_lss.onboard.core.landing.assess", "the landing modules"),
        ("autopilot_node", "pymavlink", "its parameters and topics"),
    ],
)
def test_starting_node_logs_missing_inputs(ros, name, module, what):
    """Simulate a loaded computer, on which the modules take half a minute to load."""
    go = ros.folder / "go"
    node = ros.start(name, first=HELD_UP.format(module=module, go=str(go)))
    first = {"mapping_node": "'/lidar/points'", "lss_node": "a map", "autopilot_node": "the heart"}
    with ros.listen({}) as listener:
        told = f"[{name}]: starting, waiting for {what}"
        listener.until(lambda: told in node.output())
        assert "takes " not in node.output()
        go.touch()
        waits = f"waiting for {first[name]}"
        listener.until(lambda: waits in node.output())
        listener.until(listener.told, name, (), waits)


@pytest.mark.quick("lss_node")
@pytest.mark.parametrize("name", ["mapping_node", "lss_node", "autopilot_node"])
def test_missing_simulated_time_is_reported(ros, name):
    """This happens on a vehicle with the parameter file of its simulation."""
    node = ros.start(name, "-p", "use_sim_time:=true")
    with ros.listen({}) as listener:
        listener.until(listener.at_least, "problems.no_clock", 1, name)
        assert "'/clock'" in node.output(), node.output()
        sender = listener.node.create_publisher(Clock, "/clock", stream(1, reliable=True))

        def quiet():
            sender.publish(Clock(clock=time_message(10**9)))
            return "'/clock'" not in listener.diagnostics[name].message

        listener.until(quiet)


ONBOARD_ALONE = """
import sys
class Refused:
    def find_spec(self, name, path=None, target=None):
        if name.startswith(("quadtree_lss.desk", "quadtree_lss.lab")) or name in {lacking}:
            raise ImportError(f"{{name}} is not on the vehicle")
sys.meta_path.insert(0, Refused())
"""


@pytest.mark.slow
def test_nodes_run_with_required_packages_only(ros):
    """Hide the other packages, and all extras except rclpy and its messages."""
    asked = (Requirement(line) for line in metadata.requires("quadtree_lss") or [])
    of_extras = {item.name for item in asked if item.marker and "wheels" not in str(item.marker)}
    brought = metadata.packages_distributions().items()
    names = {name for name, distributions in brought if of_extras & set(distributions)}
    assert {"matplotlib", "rosbags", "tqdm"} <= names
    ros.start("mapping_node", first=ONBOARD_ALONE.format(lacking=sorted(names)))
    lss = ros.start("lss_node")
    with ros.sensors() as (listener, sensors):
        sensors.publish(4)
        listener.until(lambda: "first sites: 3" in lss.output())
    refused = ros.run(sys.executable, "-c", "import quadtree_lss.desk.replay.replay")
    assert "is not on the vehicle" in refused.stderr


def test_full_map_is_reported(ros):
    ros.start("mapping_node", "-p", "mapping.max_cells:=64")
    with ros.sensors() as (listener, sensors):
        sensors.publish(2)
        listener.until(listener.at_least, "map.refused_divisions", 1)
        later = last_scan_ns(2) + 500_000_000
        calm = np.full((4, 4, 3), [0.0, 0.0, 100.0])
        calm[..., 0] += np.linspace(-0.3, 0.3, 4)
        sensors.poses.publish(pose(later))
        sensors.scans.publish(cloud(later, calm))
        listener.until(listener.has, "scan.stamp_ns", later)
        assert "the map is full" in listener.diagnostics["mapping_node"].message
