# SPDX-License-Identifier: Apache-2.0
"""A bag to a results folder: contract of the files, determinism, counts, damage."""

import csv

import numpy as np
import pytest
from replay.recordings import CLOUD, GROUND, POSE, SECOND, START, flight, recording, write_ros2

from quadtree_lss.desk.bags.topics import POSE_TOPIC, SCAN_TOPIC
from quadtree_lss.desk.replay.files import ReplayError
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.onboard.config.settings import config_from_values

pytestmark = pytest.mark.xdist_group("replay")  # its flight is made once

CONFIG = config_from_values(GROUND)
FILES = set("history.npz sites.csv selected.csv cells.npz".split())
FILES |= set("grid.npz timing.csv summary.json config.yaml".split())


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_ros2(tmp_path_factory.mktemp("bag") / "bag")


@pytest.fixture(scope="module")
def result(bag, tmp_path_factory):
    return replay(bag, tmp_path_factory.mktemp("out"), CONFIG, report=True)


def columns(path):
    with open(path, newline="") as file:
        return list(csv.reader(file))[1:]


def arrays(path):
    with np.load(path, allow_pickle=False) as content:
        return {name: content[name] for name in content.files}


def same(first, second):
    assert first.keys() == second.keys()
    for name, array in first.items():
        assert array.dtype == second[name].dtype
        np.testing.assert_array_equal(array, second[name])


def test_the_folder_holds_the_files_and_nothing_else(result):
    names = {p.name for p in result.out.iterdir()}
    assert names == FILES | {"report.html", "figures"}
    figures = {p.name for p in (result.out / "figures").iterdir()}
    layers = ("elevation", "hazards", "score", "probability")
    assert figures == {f"{name}.png" for name in layers}


def test_cells_hold_the_contract_and_the_slope_that_was_flown_over(result):
    cells = arrays(result.out / "cells.npz")
    m = len(cells["level"])
    shapes = {name: array.shape for name, array in cells.items()}
    flat = "level ix iy x y size z nx ny nz count measured roughness exception_fraction"
    flat = [*flat.split(), "observed"]
    expected = dict.fromkeys(flat, (m,))
    expected |= {"covariance": (m, 3, 3), "feature": (m, 5), "domain": (5,)}
    expected |= {"covariance_pose": (m, 3, 3), "observed_cells": (64, 64)}
    expected |= {"low": (m,), "high": (m,), "coverage": (m,), "known_cells": (64, 64)}
    expected |= {"offset": (2,), "stamp_ns": ()}
    assert shapes == expected
    assert cells["measured"].dtype == np.bool_
    np.testing.assert_array_equal(cells["domain"], [-16.0, -16.0, 32.0, 3, 6])
    np.testing.assert_allclose(cells["size"], 32.0 / 2.0 ** cells["level"])
    np.testing.assert_allclose(cells["x"], -16.0 + (cells["ix"] + 0.5) * cells["size"])
    assert np.sum(cells["size"] ** 2) == pytest.approx(32.0**2)
    known = cells["measured"] & np.isfinite(cells["z"])
    assert known.sum() > 20
    np.testing.assert_allclose(cells["z"][known], 0.05 * cells["x"][known], atol=0.1)
    normal = np.column_stack([cells[n][known] for n in ("nx", "ny", "nz")])
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0)
    assert (normal[:, 2] > 0.0).all()


def test_unobserved_ground_is_not_safe_and_has_no_score(result):
    grid = arrays(result.out / "grid.npz")
    np.testing.assert_allclose(np.diff(grid["x"]), CONFIG.lss.spacing)
    assert grid["x"][0] == grid["y"][0] == -16.0
    assert not grid["safe"][(grid["hazard"] & 128) > 0].any()
    assert np.isnan(grid["score"][~grid["safe"]]).all()


def test_tables_hold_sites_targets_and_scans(result):
    rows = columns(result.out / "sites.csv")
    assert [int(row[0]) for row in rows] == list(range(1, len(rows) + 1))
    safe = [float(row[13]) for row in rows]
    # Of sites that are equal within the error of the risk model clearance decides.
    assert max(b - a for a, b in zip(safe, safe[1:], strict=False)) < 0.01
    assert 0.5 < min(safe) and max(safe) <= 1.0
    rows = columns(result.out / "selected.csv")
    reasons = [row[-1] for row in rows]
    assert reasons[0] == "first" and set(reasons[1:]) <= {"better"} and rows[0][1] != "0"
    rows = columns(result.out / "timing.csv")
    assert [int(row[0]) for row in rows] == [
        START + k * SECOND // 10 + SECOND // 50 for k in range(10)
    ]


def test_the_same_bag_gives_bit_identical_results(bag, result, tmp_path):
    again = replay(bag, tmp_path, CONFIG, report=False)
    for name in ("cells.npz", "grid.npz"):
        same(arrays(result.out / name), arrays(tmp_path / name))
    assert (tmp_path / "sites.csv").read_bytes() == (result.out / "sites.csv").read_bytes()
    assert again.summary["points_dropped"] == result.summary["points_dropped"]


def test_points_that_miss_the_map_are_counted_and_told(bag):
    def run(**values):
        config = config_from_values({k.replace("__", "."): v for k, v in values.items()}, CONFIG)
        result = replay(bag, None, config)
        summary = result.summary
        assert summary["points_used"] + sum(summary["points_dropped"].values()) == summary["points"]
        assert summary["points_used"] == sum(row.points_used for row in result.timings)
        return summary, result.warnings, result.assessment.explanation

    summary, warnings, _ = run(domain__xmin=-32.0, domain__ymin=-32.0, domain__size=64.0)
    assert summary["doubts"] and summary["doubts"][0] in warnings
    assert summary["points_used"] > 0.9 * summary["points"]
    assert not any("can be used" in line for line in warnings)
    summary, warnings, explanation = run(domain__xmin=5000.0)
    assert summary["points_used"] == 0 and "nothing is mapped: points 0 of" in explanation
    assert "100 % outside the domain" in explanation
    (told,) = (line for line in warnings if "can be used" in line)
    assert "none of 5760 points" in told and "x 5000 ... 5032" in told and "middle" in told
    _, warnings, explanation = run(lidar__max_range=10.0)
    (told,) = (line for line in warnings if "can be used" in line)
    assert "out of range (lidar.min_range, lidar.max_range)" in told and "domain" not in told
    assert "100 % out of range" in explanation
    summary, warnings, _ = run(domain__ymin=8.0)
    (told,) = (line for line in warnings if "can be used" in line)
    assert told.startswith("only ") and summary["points_used"] > 0


def test_unusable_messages_are_counted_and_the_rest_is_mapped(tmp_path):
    path = tmp_path / "bag"
    with recording(path) as recorder:
        flight(recorder)
        bad = recorder.cloud(START + SECOND, np.ones((2, 2, 3)))
        bad.width = 3
        recorder.write(SCAN_TOPIC, bad, CLOUD, START + SECOND)
        wrong = recorder.pose(START + SECOND, (0, 0, 0), frame="odom")
        recorder.write(POSE_TOPIC, wrong, POSE, START + SECOND)
        recorder.write_raw(SCAN_TOPIC, b"\x00\x01\x00\x00junk", CLOUD, START + SECOND)
    result = replay(path, tmp_path / "out", CONFIG, report=False)
    assert result.summary["scans"] == 10
    assert result.summary["scans_dropped"] == {"cloud_size": 1, "cloud_encoding": 1}
    assert result.summary["messages_rejected"]["pose_frame"] == 1
    assert any("odom" in line for line in result.warnings)


def test_a_bag_of_which_no_scan_finds_a_pose_says_why(tmp_path):
    config = config_from_values({"frames.map": "planet"}, CONFIG)
    path = write_ros2(tmp_path / "bag", scans=3)
    with pytest.raises(ReplayError, match="'map', expected 'planet'") as caught:
        replay(path, tmp_path / "out", config, report=False)
    assert "\n" not in str(caught.value)
