# SPDX-License-Identifier: Apache-2.0
"""Benchmark scripts run to their end and print their tables; what they print is not judged, but for
what the map of one that hovers claims, however long the same ground is seen."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmark"))

import hover
import probability

FOLDER = Path(hover.__file__).parent
SMALL = {
    "scan_update": (
        ["--duration", "1", "--largest", "64"],
        ["plain compiled loop", "numpy.bincount", "binned_statistic_2d"],
    ),
    "methods": (
        ["--parabola", "201", "--morpheus", "202", "--duration", "2"],
        ["by the paper", "covariance"],
    ),
    "arducopter": ([], ["nothing flown: ARDUCOPTER names no"]),
    "px4": ([], ["nothing flown: PX4 names no"]),
    "depth": (["--seeds", "9421", "--duration", "2"], ["unsafe called safe", "scan update"]),
    "follow": (
        ["--seeds", "9481", "--length", "80", "--moments", "3"],
        ["moves of the square", "and to the bit"],
    ),
    "hover": (["--flights", "1", "--scans", "20", "50"], ["white", "Gauss-Markov", "constant"]),
    "section_vi": (["--seeds", "201", "--duration", "3"], ["187", "220", "one degree"]),
    "features": (["--seeds", "201"], ["0.15 - 0.4 m", "in 10 cm", "slope of 10 degrees"]),
    "probability": (
        ["--shipped", "--seeds", "90000-90001", "--figure", "p.png"],
        ["the shipped model", "Brier", "Operating points"],
    ),
    "drone": (["--seeds", "201-202"], ["2 flights", "max_risk"]),
    "scarce": (["--seeds", "97000"], ["1 flights", "with 1 m of room"]),
    "partly_seen": (
        ["--quick", "--seeds", "201"],
        ["edge: rock", "footprints: 1 degree", "inside: 180", "drops of"],
    ),
    "shares": (
        ["--draws", "200", "--of-twenty", "50", "--rolling", "3", "--figure", "c.png"],
        ["error over claimed deviation", "20, all"],
    ),
    "wrong_poses": (["--seeds", "1", "--before", "3"], ["wrong scans refused", "hills"]),
    "landing_pass": (["--duration", "1", "--repeats", "1"], ["the paper's rules"]),
    "target": (["--seeds", "201", "--told"], ["withdrawn from truly safe ground", "truth off by"]),
    "live": (["--seconds", "6", "--kill", "4"], ["By the minute", "scans sent", "lss_node"]),
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


def test_maps_of_one_ground_leave_a_risk_no_surer():
    """Whose failures are the same, tile by tile."""
    rng = np.random.default_rng(3)
    tile = np.repeat(np.arange(600), 50)
    failed, risk = (rng.random(600) < 0.02)[tile], np.full(tile.size, 0.02)
    judged = probability.Judged(np.zeros((tile.size, 1)), failed, tile, 1.0)
    once, thrice = (probability.line([(judged, risk)] * times)[2] for times in (1, 3))
    assert once == thrice


def test_a_seed_of_another_family_is_another_flight(tmp_path, monkeypatch):
    asked = []
    noted = lambda family, seed, *_: asked.append((family, seed)) or []  # noqa: E731
    monkeypatch.setattr(probability, "fly", noted)
    for seeds in ([5], [4, 5], [4, 5]):
        probability.flown(seeds, None, tmp_path, [])
    whole, thin, *_ = probability.FAMILIES.values()
    assert asked == [(whole, 5), (whole, 4), (thin, 5)]


@pytest.mark.parametrize("align", [True, False])
@pytest.mark.parametrize("kind", hover.KINDS)
def test_errors_are_as_claimed(kind, align):
    """Over claimed deviations, root mean square, of height and slopes after 100 and 1000 scans; few
    flights share few errors, so the bounds are wide."""
    maps = [hover.hovering(hover.KINDS[kind], align) for _ in range(5)]
    found = np.array([hover.hover(one, 950 + k, [100, 1000]) for k, one in enumerate(maps)])
    ratio = found[:, :, 0] / found[:, :, 1]
    found = np.array([hover.both(ratio[:, at]) for at in range(2)])
    assert (found > 0.35).all() and (found < 1.9).all()
