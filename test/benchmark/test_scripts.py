# SPDX-License-Identifier: Apache-2.0
"""Benchmark scripts run to their end and print their tables."""

import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[2] / "benchmark"
SMALL = {
    "scan_update": (
        ["--duration", "1", "--growth", "--largest", "64"],
        ["plain compiled loop"],
    ),
    "arducopter": ([], ["nothing flown: ARDUCOPTER names no"]),
    "px4": ([], ["nothing flown: PX4 names no"]),
    "recordings": (["--data", "nowhere"], ["no recordings in nowhere"]),
    "study": (
        [str(FOLDER.parent / "studies" / "small.yaml"), "safe_found", "--out", "out"],
        ["Safe terrain found", "touchdown", "paper"],
    ),
    "hover": (["--flights", "1", "--scans", "20", "50"], ["white", "Gauss-Markov", "constant"]),
    "section_vi": (["--seeds", "201", "--duration", "3"], ["187", "220", "prefit below"]),
    "features": (["--seeds", "201"], ["0.15 - 0.4 m", "in 10 cm", "slope of 10 degrees"]),
    "probability": (
        ["--seeds", "90000-90001", "--jobs", "1", "--figure", "p.png"],
        ["predicted risk in %", "Brier", "lss.max_risk"],
    ),
    "drone": (["--seeds", "201-202"], ["2 flights", "max_risk"]),
    "scarce": (["--seeds", "97000"], ["1 flights", "with 1 m of clearance"]),
    "partly_seen": (
        ["--quick", "--seeds", "201"],
        ["edge: rock", "footprints: 1 degree", "inside: 180", "drops of"],
    ),
    "shares": (
        ["--draws", "200", "--of-twenty", "50", "--rolling", "3"],
        ["error over claimed deviation", "20, all"],
    ),
    "wrong_poses": (["--seeds", "1", "--before", "3"], ["wrong scans rejected", "hills"]),
    "landing_pass": (["--duration", "1", "--repeats", "1"], ["the paper's rules"]),
    "target": (
        ["--seeds", "201", "--predicted"],
        ["withdrawals from truly safe ground", "truth off by"],
    ),
    "live": (
        ["--seconds", "8", "--kill", "3"],
        ["Restarts of a killed node"],
    ),
}
NEED_ROS = {"arducopter", "px4", "live"}


def test_every_script_is_tried():
    assert {path.stem for path in FOLDER.glob("*.py")} == set(SMALL)


@pytest.mark.slow
@pytest.mark.parametrize("script", SMALL)
def test_script_prints_its_tables(script, tmp_path):
    if script in NEED_ROS:
        pytest.importorskip("rclpy")
    arguments, expected = SMALL[script]
    done = subprocess.run(
        [sys.executable, str(FOLDER / f"{script}.py"), *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert "cores" in done.stdout and "NumPy" in done.stdout
    for text in expected:
        assert text in done.stdout
    assert "nan" not in done.stdout
