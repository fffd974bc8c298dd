# SPDX-License-Identifier: Apache-2.0
"""Names, types and columns that other programs rely on, as the specification lists them."""

import argparse
import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from replay.recordings import GROUND, write_ros2
from rosbags.highlevel import AnyReader

from quadtree_lss import cli
from quadtree_lss.desk.replay.configuration import shipped_configs
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.lab.simulation.simulate import simulate
from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.landing import hazards
from quadtree_lss.onboard.messages import landing_inputs

pytestmark = pytest.mark.xdist_group("contracts")  # its flight is made once

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = "default morpheus parabola parabola_fixed flight drone depth_camera"
COMMANDS = "replay simulate evaluate fly campaign sites compare export view info doctor config"
TABLES = {
    "sites.csv": "rank,x,y,z,nx,ny,nz,score,slope_deg,roughness,hazard_distance,subscale_height,"
    "id,probability",
    "selected.csv": "stamp_ns,id,x,y,z,probability,reason",
    "timing.csv": "stamp_ns,points,points_used,leaves,divisions,map_ms",
}
ARRAYS = {
    "cells.npz": "level ix iy x y size z nx ny nz covariance count measured roughness"
    " exception_fraction feature domain",
    "grid.npz": "x y elevation plane_elevation slope_deg hazard safe score risk probability",
}
TRUTH = "x y elevation safe_x safe_y safe box scan_stamp_ns scan_position scan_quaternion_xyzw"
BITS = {
    "SLOPE": 1,
    "ELEVATION": 2,
    "EXCEPTION": 4,
    "TOUCHDOWN": 8,
    "UNCERTAIN": 16,
    "PARTLY_UNOBSERVED": 32,
    "UNMAPPED": 64,
    "UNSEEN": 128,
}
CLOUD, GRID = "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/OccupancyGrid"
POSE, ODOMETRY = "geometry_msgs/msg/PoseWithCovarianceStamped", "nav_msgs/msg/Odometry"
POLYGON, MARKERS = "geometry_msgs/msg/PolygonStamped", "visualization_msgs/msg/MarkerArray"
POSES = {"nav/pose": POSE, "nav/odometry": ODOMETRY}
MAP = {"map/cells": CLOUD, "map/observed": GRID}
LANDING = {
    "landing/sites": "geometry_msgs/msg/PoseArray",
    "landing/selected": POSE,
    "landing/status": CLOUD,
    "landing/site_table": CLOUD,
    "landing/hazards": GRID,
    "landing/score": GRID,
    "landing/probability": GRID,
    "landing/grid_map": "grid_map_msgs/msg/GridMap",
}
HEARD = {
    "landing/area": POLYGON,
    "landing/keep_out": POLYGON,
    "landing/keep_outs": "geometry_msgs/msg/PolygonInstanceStamped",
    "landing/target": "geometry_msgs/msg/PointStamped",
    "landing/dispersion": POSE,
}
SENSORS = {
    "lidar/points": CLOUD,
    **POSES,
    "lidar/gimbal": "geometry_msgs/msg/TransformStamped",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "depth/image": "sensor_msgs/msg/Image",
    "depth/camera_info": "sensor_msgs/msg/CameraInfo",
}
DIAGNOSTICS = {"/diagnostics": "diagnostic_msgs/msg/DiagnosticArray"}
AUTOPILOT = {"landing/autopilot": "diagnostic_msgs/msg/DiagnosticStatus", "nav/odometry": ODOMETRY}
TRIGGER = "std_srvs/srv/Trigger"
SERVICES = {
    "mapping_node": ("~/reset", "~/save_map", "~/load_map"),
    "lss_node": ("~/release", "~/land_now"),
    "autopilot_node": ("~/land",),
}
SUBSCRIBED = {"mapping_node": SENSORS, "lss_node": MAP | POSES | HEARD, "autopilot_node": {}}
PUBLISHED = {
    "mapping_node": {**MAP, "map/markers": MARKERS, **DIAGNOSTICS},
    "lss_node": {**LANDING, "landing/markers": MARKERS, **DIAGNOSTICS},
    "autopilot_node": AUTOPILOT | DIAGNOSTICS,
}


def used_by(name):
    """(what, name, type) of all topics and services of a node; ``what`` as in an SROS 2 policy."""
    found = {("subscribe", *item) for item in SUBSCRIBED[name].items()}
    found |= {("publish", *item) for item in PUBLISHED[name].items()}
    return found | {("reply", service, TRIGGER) for service in SERVICES[name]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("contracts")
    bag, record = write_ros2(folder / "bag", scans=5), folder / "products"
    replay(bag, folder / "out", config_from_values(GROUND), record=record)
    return folder


@pytest.mark.parametrize("name", TABLES)
def test_tables_have_these_columns_in_this_order(folder, name):
    with (folder / "out" / name).open(newline="") as file:
        header, *rows = csv.reader(file)
    assert ",".join(header) == TABLES[name]
    assert all(len(row) == len(header) for row in rows)


@pytest.mark.parametrize("name", ARRAYS)
def test_archives_hold_these_arrays(folder, name):
    with np.load(folder / "out" / name) as arrays:
        assert set(ARRAYS[name].split()) <= set(arrays.files)
        if name == "cells.npz":
            leaves = len(arrays["level"])
            assert arrays["covariance"].shape == (leaves, 3, 3)
            assert arrays["feature"].shape == (leaves, 5)
        else:
            shape = (len(arrays["y"]), len(arrays["x"]))
            assert {arrays[k].shape for k in arrays.files if k not in "xy"} == {shape}


def test_a_folder_has_summary_page_and_figures(folder):
    summary = json.loads((folder / "out" / "summary.json").read_text())
    assert {"scans_dropped", "points_dropped", "warnings", "versions", "config"} <= summary.keys()
    assert (folder / "out" / "report.html").exists()
    assert [*(folder / "out" / "figures").glob("*.png")]


def test_bits_of_hazard_mean_the_same():
    assert {name: getattr(hazards, name) for name in BITS} == BITS


def test_messages_have_these_topics_and_types(folder):
    with AnyReader([folder / "products"]) as reader:
        found = {c.topic.removeprefix("/"): c.msgtype for c in reader.connections}
    assert found == MAP | LANDING
    heard = {f"landing/{name}": kind for name, kind in landing_inputs.TYPES.items()}
    assert HEARD.items() <= heard.items()


@pytest.mark.parametrize("name", SERVICES)
def test_topics_and_services_of_a_node_are_documented(name):
    """In headings, as `topic`, `topic` – `type`, `type`; of services in a table. What the nodes use
    is compared in test/ros/test_security_policy.py."""
    text = "".join(page.read_text() for page in (ROOT / "msg_docs").glob("*.md"))
    titles = re.findall(r"^#+ (.*) – (.*)$", text, re.MULTILINE)
    documented = [[re.findall("`([^`]+)`", part) for part in title] for title in titles]
    for what, topic, kind in used_by(name):
        if what == "reply":
            assert f"| `/{name}/{topic.removeprefix('~/')}` |" in text, topic
        else:
            short = kind.replace("/msg/", "/")
            assert any(topic in topics and short in kinds for topics, kinds in documented), topic


def test_the_truth_of_a_simulation_has_these_arrays(tmp_path):
    simulate("descent", tmp_path / "bag", seed=1, duration=1.0)
    with np.load(tmp_path / "truth.npz") as arrays:
        assert set(TRUTH.split()) <= set(arrays.files)


def test_commands_and_configurations_have_these_names():
    (commands,) = (
        action.choices
        for action in cli._parser()._actions
        if isinstance(action, argparse._SubParsersAction)
    )
    assert set(commands) == {*COMMANDS.split(), "fit-risk"}
    assert set(CONFIGS.split()) <= set(shipped_configs())
