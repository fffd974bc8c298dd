# SPDX-License-Identifier: Apache-2.0
"""The command line: exit codes, one-line errors, what stands on stdout and stderr."""

import signal
import subprocess
import sys
import time

import pytest
from replay.recordings import storage_file, write_ros2

from quadtree_lss.cli import main, main_replay_bag, without_ros_arguments

AREA = ["--set", "domain.xmin=-16.0", "--set", "domain.ymin=-16.0", "--set", "domain.size=32.0"]
COARSE = [*AREA, "--set", "domain.min_level=3", "--set", "domain.max_level=5"]
FAST = [*COARSE, "--set", "lss.max_gap=3.0", "--no-report"]


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    return write_ros2(tmp_path_factory.mktemp("bag") / "bag", scans=6)


def run(capsys, *arguments):
    code = main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    assert "Traceback" not in err
    return code, out, err


def test_a_replay_prints_its_sites_and_is_quiet_otherwise(bag, tmp_path, capsys):
    code, out, err = run(capsys, "replay", bag, "--out", tmp_path, *FAST)
    assert code == 0
    assert "6 scans mapped" in out and "rank" in out and str(tmp_path) in out
    assert all(line.startswith("quadtree-lss: warning:") for line in err.splitlines())


def test_verbose_shows_a_progress_bar(bag, tmp_path, capsys):
    _, _, err = run(capsys, "replay", bag, "--out", tmp_path, *FAST, "-v")
    assert "replay" in err and "%" in err


def test_a_damaged_bag_gives_exit_code_3(tmp_path, capsys):
    path = write_ros2(tmp_path / "bag")
    file = storage_file(path)
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    code, out, err = run(capsys, "replay", path, "--out", tmp_path / "out", *FAST)
    assert code == 3
    assert "truncated" in err and "scans mapped" in out
    assert (tmp_path / "out" / "cells.npz").exists()


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["replay", "{none}", "--out", "{out}"], "no such bag"),
        (["replay", "{bag}", "--out", "{out}", "--config", "{none}"], "no configuration file"),
        (["replay", "{bag}", "--out", "{out}", "--set", "domain.sise=3"], "domain.size"),
        (["replay", "{bag}", "--out", "{out}", "--scan-topic", "/x"], "/lidar/points"),
        (["replay", "{bag}", "--out", "{out}", "--start", "1e9"], "--start"),
        (["replay", "{bag}", "--out", "{bag}/metadata.yaml"], "metadata.yaml"),
        (["config", "--config", "{none}"], "no configuration file"),
        (["evaluate", "{none}", "--truth", "{none}"], "none"),
    ],
)
def test_errors_are_one_line_and_exit_code_1(bag, tmp_path, capsys, arguments, word):
    places = {"bag": bag, "out": tmp_path / "out", "none": tmp_path / "none"}
    code, out, err = run(capsys, *(argument.format(**places) for argument in arguments))
    assert code == 1 and out == ""
    assert word in err and err.startswith("quadtree-lss: error: ") and err.count("\n") == 1


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["nonsense"],
        ["replay"],
        ["replay", "bag"],
        ["replay", "bag", "--out", "x", "--start", "soon"],
        ["replay", "bag", "--out", "x", "--set", "lss.margin"],
        ["simulate", "moon", "--out", "x"],
        ["simulate", "morpheus"],
        ["evaluate", "x"],
    ],
)
def test_wrong_usage_is_exit_code_2(capsys, arguments):
    code, _, err = run(capsys, *arguments)
    assert code == 2 and "usage:" in err


@pytest.mark.parametrize("command", ["replay", "simulate", "evaluate", "config"])
def test_help_has_examples(capsys, command):
    code, out, _ = run(capsys, command, "--help")
    assert code == 0 and f"quadtree-lss {command}" in out and "examples:" in out


def test_config_prints_a_file_that_it_reads_again(tmp_path, capsys):
    _, first, _ = run(capsys, "config", "--config", "morpheus", "--set", "lss.margin=1.5")
    assert "margin: 1.5" in first and "# " in first
    path = tmp_path / "mine.yaml"
    path.write_text(first)
    assert run(capsys, "config", "--config", path)[1] == first
    assert "#" not in run(capsys, "config", "--plain")[1]


def test_simulate_then_replay_then_evaluate(tmp_path, capsys):
    place = tmp_path / "flight" / "bag"
    arguments = ["simulate", "parabola", "--seed", 3, "--duration", 4, "--out", place]
    code, out, _ = run(capsys, *arguments)
    assert code == 0 and (tmp_path / "flight" / "truth.npz").exists() and "truth.npz" in out
    code, _, err = run(capsys, *arguments)
    assert code == 1 and str(place) in err
    assert run(capsys, *arguments, "--overwrite")[0] == 0
    out = tmp_path / "results"
    code, _, _ = run(capsys, "replay", place, "--out", out, "--config", "parabola", "--no-report")
    assert code == 0
    truth = tmp_path / "flight" / "truth.npz"
    code, shown, _ = run(capsys, "evaluate", out, "--truth", truth)
    assert code == 0 and "Elevation error" in shown


def test_publishing_without_ros_says_so(bag, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "quadtree_lss.ros.player", None)  # what `import` then meets
    code, _, err = run(capsys, "replay", bag, "--publish")
    assert code == 1 and "rclpy" in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("given", "kept"),
    [
        (["bag", "--out", "x"], ["bag", "--out", "x"]),
        (["bag", "--ros-args", "-r", "__node:=x"], ["bag"]),
        (["--ros-args", "-p", "a:=1", "--", "bag", "--out", "x"], ["bag", "--out", "x"]),
        (["a", "--ros-args", "-r", "b:=c", "--", "d", "--ros-args"], ["a", "d"]),
    ],
)
def test_arguments_of_ros_are_left_out(given, kept):
    assert without_ros_arguments(given) == kept


def test_the_executable_of_ros2_run(bag, tmp_path, capsys, monkeypatch):
    arguments = ["replay_bag", str(bag), "--out", str(tmp_path), *FAST, "--ros-args", "-r", "a:=b"]
    monkeypatch.setattr(sys, "argv", arguments)
    assert main_replay_bag() == 0
    assert "scans mapped" in capsys.readouterr().out


def test_interrupting_is_clean(tmp_path):
    path = write_ros2(tmp_path / "bag", scans=2000)
    command = [sys.executable, "-m", "quadtree_lss.cli", "replay", str(path)]
    command += ["--out", str(tmp_path / "out"), *FAST]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not (tmp_path / "out").exists():  # until it maps
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    # CPython ends by the signal itself if that came within an exec(); a shell shows 130 for both.
    assert process.returncode in (130, -signal.SIGINT), err
    assert "interrupted" in err and "Traceback" not in err
    assert list((tmp_path / "out").iterdir()) == []
