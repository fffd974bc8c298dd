# SPDX-License-Identifier: Apache-2.0
"""Names, types and columns that other programs rely on, as the specification lists them."""

import argparse
import csv
import json

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
PUBLISHED = {
    "map/cells": "sensor_msgs/msg/PointCloud2",
    "map/observed": "nav_msgs/msg/OccupancyGrid",
    "landing/sites": "geometry_msgs/msg/PoseArray",
    "landing/selected": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "landing/status": "sensor_msgs/msg/PointCloud2",
    "landing/site_table": "sensor_msgs/msg/PointCloud2",
    "landing/hazards": "nav_msgs/msg/OccupancyGrid",
    "landing/score": "nav_msgs/msg/OccupancyGrid",
    "landing/probability": "nav_msgs/msg/OccupancyGrid",
    "landing/grid_map": "grid_map_msgs/msg/GridMap",
}
HEARD = {
    "area": "geometry_msgs/msg/PolygonStamped",
    "keep_out": "geometry_msgs/msg/PolygonStamped",
    "keep_outs": "geometry_msgs/msg/PolygonInstanceStamped",
    "target": "geometry_msgs/msg/PointStamped",
}


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
    assert found == PUBLISHED
    assert HEARD.items() <= landing_inputs.TYPES.items()


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
