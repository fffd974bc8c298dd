# SPDX-License-Identifier: Apache-2.0
"""The command line: exit codes, one-line errors, what stands on stdout and stderr."""

import json
import re
import signal
import subprocess
import sys

import numpy as np
import pytest
from installed import PREFIX, error_without
from replay.recordings import write_ros2

from quadtree_lss.cli import main, without_ros_arguments

AREA = ["--set", "domain.xmin=-16.0", "--set", "domain.ymin=-16.0", "--set", "domain.size=32.0"]
COARSE = [*AREA, "--set", "domain.min_level=3", "--set", "domain.max_level=5"]
WRONG = [("--start", "-1"), ("--start", "nan"), ("--start", "inf")]
WRONG += [("--duration", value) for value in ("0", "-1", "inf", "nan")]
WRONG_FLIGHTS = [("--duration", "0"), ("--duration", "inf"), ("--range-noise", "-1")]
WRONG_FLIGHTS += [("--outliers", "1.5"), ("--dropouts", "-0.1"), ("--flights", "0")]
WRONG_FLIGHTS += [("--flights", "1.5"), ("--seed", "-1"), ("--seed", "one")]
NOT_PUBLISHED = [["--out", "x"], ["--config", "morpheus"], ["--set", "lss.margin=1"]]
NOT_PUBLISHED += [["--no-report"], ["--record", "x"]]
NOT_PUBLISHED += [["--rate", value] for value in ("0", "-1", "inf", "nan")]
UNUSED = [["campaign", "a", "--out", "x", "--keep", "1", "--rerun", "2"]]
UNUSED += [["config", "--node", "/lss_node"]]
UNUSED += [["config", "check", "morpheus", "--set", "lss.margin=1"], ["doctor", "x", "--seconds=3"]]
UNUSED += [["config", "explain", "lss", "--scan-topic", "x"]]
FAST = [*COARSE, "--set", "lss.max_gap=3.0", "--set", "lss.max_risk=0.9", "--no-report"]


def run(capsys, *arguments):
    code = main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    assert "Traceback" not in err
    return code, out, err


def test_a_replay_prints_its_sites_and_is_quiet_otherwise(bag, tmp_path, capsys):
    code, out, err = run(capsys, "replay", bag, "--out", tmp_path, *FAST)
    assert code == 0
    assert "6 scans mapped" in out and "rank" in out and str(tmp_path) in out
    assert "\npoints " in out and "of 3456 used" in out
    assert all(line.startswith("quadtree-lss: warning:") for line in err.splitlines())


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["replay", "{none}", "--out", "{out}"], "no such bag"),
        (["replay", "{bag}", "--out", "{out}", "--scan-topic", "/x"], "/lidar/points"),
        (["replay", "{bag}", "--out", "{bag}/metadata.yaml"], "metadata.yaml"),
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
        ["info"],
        ["config", "check"],
        ["replay", "bag", "--out", "x", "--start", "soon"],
        ["replay", "bag", "--out", "x", "--set", "lss.margin"],
        ["replay", "bag", "--out", "x", "--set", "=1"],
        *(["replay", "bag", option, value] for option, value in WRONG),
        ["replay", "bag", "--rate", "2"],
        *(["replay", "bag", "--publish", *more] for more in NOT_PUBLISHED),
        *(["simulate", "descent", "--out", "x", option, value] for option, value in WRONG_FLIGHTS),
        *UNUSED,
        ["simulate", "moon", "--out", "x"],
        ["evaluate", "x"],
        ["replay", "bag", "--out", ""],
        ["replay", ""],
        ["info", " "],
        ["simulate", "descent", "--out", ""],
    ],
)
def test_wrong_usage_is_exit_code_2(capsys, arguments):
    code, out, err = run(capsys, *arguments)
    assert code == 2 and "--help)" in err and err.count("\n") == 1
    told = run(capsys, *arguments, "--json")[1]
    assert not out and json.loads(told)["exit_code"] == 2


@pytest.mark.parametrize("command", ["replay", "info", "config", "simulate", "evaluate"])
def test_help_has_examples(capsys, command):
    code, out, _ = run(capsys, command, "--help")
    assert code == 0 and f"quadtree-lss {command}" in out and "examples:" in out
    assert "exit codes:" in out


def test_config_prints_a_file_that_it_reads_again(tmp_path, capsys):
    _, first, _ = run(capsys, "config", "--config", "morpheus", "--set", "lss.margin=1.5")
    assert "margin: 1.5" in first and "# " in first
    path = tmp_path / "mine.yaml"
    path.write_text(first)
    assert run(capsys, "config", "--config", path)[1] == first


@pytest.mark.slow
def test_simulate_then_replay_then_evaluate(tmp_path, capsys):
    place = tmp_path / "flight" / "bag"
    arguments = ["simulate", "parabola", "--seed", 3, "--duration", 2, "--out", place]
    code, out, _ = run(capsys, *arguments)
    assert code == 0 and (tmp_path / "flight" / "truth.npz").exists() and "truth.npz" in out
    code, _, err = run(capsys, *arguments)
    assert code == 1 and "bag exists" in err
    assert run(capsys, *arguments, "--overwrite")[0] == 0
    out = tmp_path / "results"
    code, _, _ = run(capsys, "replay", place, "--out", out, "--config", "parabola", "--no-report")
    assert code == 0
    truth = tmp_path / "flight" / "truth.npz"
    code, shown, _ = run(capsys, "evaluate", out, "--truth", truth)
    assert code == 0 and "Elevation error" in shown
    one = json.loads(run(capsys, "evaluate", out, "--truth", truth, "--json", "-q")[1])
    assert one["out"] == str(out / "evaluation") and one["elevation"]["rms"] > 0.0


@pytest.mark.parametrize(
    ("module", "arguments"),
    [
        *((module, ["replay", "none.mcap"]) for module in ("rosbags", "backports", "lz4")),
        ("rasterio", ["sites", "file.tif"]),
        ("rasterio", ["export", "results", "--format", "geotiff"]),
        ("trimesh", ["export", "results", "--format", "ply"]),
    ],
)
def test_a_missing_library_is_one_line_with_its_remedy(capsys, bag, tmp_path, module, arguments):
    (tmp_path / arguments[1]).touch()
    if arguments[0] == "export":
        (tmp_path / "results").unlink()
        run(capsys, "replay", bag, "--out", tmp_path / "results", *FAST)
    told = error_without(module, *arguments, cwd=tmp_path)
    assert re.search(rf"\b{module}\b.* is not installed.*pip install", told), told


@pytest.mark.parametrize("arguments", [["doctor"], ["replay", "none.mcap", "--publish"]])
def test_what_needs_ros_says_so(tmp_path, arguments):
    told = error_without("rclpy", *arguments, cwd=tmp_path)
    assert "needs ROS 2 (rclpy), which cannot be imported" in told and "internal" not in told


def started(*arguments):
    command = [PREFIX / "lib" / "quadtree_lss" / "quadtree-lss", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def interrupted(bag, out):
    """Exit code, stdout, stderr of a replay that gets SIGINT when it has mapped a second."""
    process = started("replay", bag, "--out", out, "-v", *FAST)
    bar = ""
    while not re.search(r"[1-9]\d* of \d\d+ s", bar):
        part = process.stderr.read(1)
        assert part, bar
        bar += part
    process.send_signal(signal.SIGINT)
    shown, err = process.communicate(timeout=300)
    told, _, rest = err.partition("interrupted")
    assert "stopping: ranks sites" in told and f"into {out} (Ctrl-C again" in told
    assert rest and "Traceback" not in err
    return process.returncode, shown, err


INTERRUPTED_START = """\
import signal, sys
from quadtree_lss import start
signal.signal(signal.SIGALRM, lambda *_: signal.raise_signal(signal.SIGINT))
signal.setitimer(signal.ITIMER_REAL, float(sys.argv[1]))
sys.exit(start.main(["config", "explain"]))
"""


@pytest.mark.parametrize("delay", [0.001, 0.01, 0.03, 0.1, 0.2])
def test_interrupting_the_start_is_one_line(delay):
    command = [sys.executable, "-c", INTERRUPTED_START, str(delay)]
    done = subprocess.run(command, capture_output=True, text=True)
    over = "config explain --help" in done.stderr  # it ended, with an error, before the signal
    assert over or (done.returncode, done.stderr) == (130, "quadtree-lss: interrupted\n")


def test_interrupting_keeps_what_was_computed(tmp_path):
    path = write_ros2(tmp_path / "bag", scans=6000)
    code, shown, err = interrupted(path, tmp_path / "out")
    assert code == 130
    assert "scans mapped" in shown and "results are of the first" in err
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["interrupted"] and 0 < summary["scans"] < 6000
    assert summary["duration"] < 600.0
    with open(tmp_path / "out" / "timing.csv") as file:
        assert len(file.readlines()) == summary["scans"] + 1


def test_a_replay_of_no_point_is_no_success(bag, tmp_path, capsys):
    elsewhere = ("--set", "domain.xmin=5000")
    code, _, err = run(capsys, "replay", bag, "--out", tmp_path, *FAST, *elsewhere)
    assert code == 1 and "no point entered the map: quadtree-lss doctor" in err


def test_json_for_scripts(bag, tmp_path, capsys):
    code, out, _ = run(capsys, "replay", bag, "--out", tmp_path, *FAST, "--json", "-q")
    result = json.loads(out)
    assert code == 0 and result["scans"] == 6 and result["out"] == str(tmp_path)
    assert [site["rank"] for site in result["sites"]] == list(range(1, len(result["sites"]) + 1))
    assert {"position", "normal", "score", "reason"} <= result["sites"][0].keys()
    info = json.loads(run(capsys, "info", bag, "--json")[1])
    assert info["works"] and info["scans_with_pose"] == 6
    values = json.loads(run(capsys, "config", "--config", "morpheus", "--json")[1])
    assert values["domain.size"] == 64.0
    explained = json.loads(run(capsys, "config", "explain", "lss.margin", "--json")[1])
    assert explained["lss.margin"]["unit"] == "m"


def test_config_checks_files_and_explains_keys(tmp_path, capsys):
    good, bad = tmp_path / "good.yaml", tmp_path / "bad.yaml"
    good.write_text("/**:\n  ros__parameters:\n    lss.margin: 1.0\n")
    bad.write_text("/**:\n  ros__parameters:\n    lss.margn: 1.0\n")
    code, out, _ = run(capsys, "config", "check", good, "morpheus")
    assert code == 0 and out.count("good\n") == 2
    code, out, _ = run(capsys, "config", "check", good, bad)
    assert code == 1 and "lss.margin" in out.splitlines()[1]
    code, out, _ = run(capsys, "config", "explain", "lss.margin")
    assert code == 0 and "default" in out and "running node" in out
    assert run(capsys, "config", "explain", "lss")[1].count("default") > 10
    assert "0.162 x vehicle.diameter" in run(capsys, "config", "explain", "lss.max_gap")[1]
    out = run(capsys, "config", "explain", "vehicle", "--set", "vehicle.clearance=0.08")[1]
    assert out == run(capsys, "config", "explain", "vehicle", "--vehicle", "3.7,0.08")[1]
    (line,) = (line for line in out.splitlines() if line.startswith("  rock_height "))
    assert "0.04 m " in line and "= 0.5 x least_hazard" in line
    assert "did you mean" not in run(capsys, "config", "explain", "")[2]
    code, _, err = run(capsys, "config", "explain", "lss.margn")
    assert code == 1 and "lss.margin" in err


WRONG_VALUES = (
    (["replay", "{bag}", "--config", "{none}"], "no configuration file"),
    (["replay", "{bag}", "--config", "morpheu"], "did you mean morpheus?"),
    (["replay", "{bag}", "--set", "domain.sise=3"], "--set: unknown"),
    (["replay", "{bag}", "--set", "lss.margin=wide"], "lss.margin"),
    (["replay", "{bag}", "--out", "{out}", "--start", "1e9"], "outside the bag"),
    (["config", "--config", "{none}"], "no configuration file"),
    (["sites", "{dem}", "--out", "{out}", "--target", "999,0"], "outside the model"),
    (["replya", "{bag}"], "try replay"),
    (["help"], "quadtree-lss --help"),
    (["replay", "{bag}", "--confg", "x"], "--config (quadtree-lss replay --help)"),
    (["config", "morpheus"], "config --config morpheus"),
    (["replay", "{dem}"], "quadtree-lss sites"),
    (["sites", "{bag}"], "quadtree-lss replay"),
)


@pytest.mark.parametrize(("arguments", "word"), WRONG_VALUES)
def test_a_wrong_argument_is_usage_and_names_what_is_meant(bag, tmp_path, capsys, arguments, word):
    dem, posts = tmp_path / "dem.npz", np.arange(10.0)
    np.savez(dem, x=posts, y=posts, elevation=np.zeros((10, 10)))
    places = {"bag": bag, "out": tmp_path / "out", "none": tmp_path / "none", "dem": dem}
    code, out, err = run(capsys, *(argument.format(**places) for argument in arguments))
    assert (code, out) == (2, "") and word in err and err.count("\n") == 1


def test_results_without_a_folder_get_one_by_time_and_a_link(bag, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        assert run(capsys, "replay", bag, *FAST)[0] == 0
    latest = tmp_path / "results" / "latest"
    folders = sorted(p for p in latest.parent.iterdir() if not p.is_symlink())
    assert len(folders) == 2 and latest.is_symlink()
    assert latest.resolve() in folders
    assert (latest / "config.yaml").exists() and (latest / "summary.json").exists()


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
