# SPDX-License-Identifier: Apache-2.0
"""Campaigns give the same files for any number of workers, after any end, by any scheduler."""

import contextlib
import csv
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from quadtree_lss.desk.commands.common import INTERRUPTED
from quadtree_lss.lab.campaign.engine import campaign
from quadtree_lss.lab.campaign.kinds import CampaignError
from quadtree_lss.lab.campaign.study import read_study

# One after the other: each has processes of its own.
pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("campaign")]

STUDY = """
name: small
scenario: descent
seed: 30002
flights: 4
conditions:
  duration: 1
  terrain: ground.npz
  range_noise: {uniform: [0.05, 0.1]}
parameters:
  lss.margin: [0.0, 1.0]
"""
COUNT = 8
PROGRAM = [str(Path(sys.executable).with_name("quadtree-lss")), "campaign"]


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    return written(tmp_path_factory.mktemp("study"), STUDY)


def written(folder, text):
    """A study, and beside it the ground that it names."""
    axis = np.arange(-10.0, 10.1, 0.25)
    bumps = 0.2 * np.sin(axis[None, :]) * np.cos(0.7 * axis[:, None])
    np.savez(folder / "ground.npz", x=axis, y=axis, elevation=bumps)
    path = folder / "study.yaml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def first(study, tmp_path_factory):
    """By one worker."""
    out = tmp_path_factory.mktemp("first")
    steps = []
    progress = {"progress": lambda done, of: steps.append((done, of))}
    return campaign(read_study(study), out, workers=1, **progress), steps


def files(out):
    return {path.name: path.read_bytes() for path in sorted((out / "flights").iterdir())}


def start(study, out, *options):
    """In a session of its own, so that signals reach nobody else."""
    command = [*PROGRAM, str(study), "--out", str(out), *map(str, options)]
    return subprocess.Popen(
        command, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def wait_until(condition, seconds=90.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def flown(out):
    return len(list(out.glob("flights/*.json")))


def test_each_flight_is_a_file_and_told(first):
    result, steps = first
    assert steps == [(k, COUNT) for k in range(COUNT + 1)]
    assert not result.failed and not result.interrupted and sorted(result.records) == [*range(8)]
    assert len(files(result.out)) == COUNT
    with (result.out / "flights.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["flight"]) for row in rows] == [*range(COUNT)]
    assert float(rows[3]["safe_found"]) == result.records[3].figures["safe_found"]
    content = json.loads((result.out / "campaign.json").read_text())
    assert [part["name"] for part in content["summary"]] == [
        "lss.margin 0.0: 4",
        "lss.margin 1.0: 4",
    ]
    page = (result.out / "campaign.html").read_text()
    assert re.search("<td>0 of [1-4]</td>", page)  # of the flights that found a site
    assert "--keep 17" in page and "Safe terrain found" in page


def test_what_was_flown_is_not_flown_again(first, study, tmp_path):
    shutil.copytree(first[0].out, tmp_path / "c")
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "c" / "flights").iterdir()}
    gone = sorted(before)[5]
    gone.unlink()
    result = campaign(read_study(study), tmp_path / "c", workers=1, rerun=[2])
    assert files(tmp_path / "c") == files(first[0].out)
    changed = {p for p, at in before.items() if p.stat().st_mtime_ns != at}
    assert changed == {gone, sorted(before)[2]}
    assert result.table() == first[0].table()
    with pytest.raises(CampaignError, match="no flight 99"):
        campaign(read_study(study), tmp_path / "c", rerun=[2, 99])
    with pytest.raises(KeyboardInterrupt):
        campaign(read_study(study), tmp_path / "c", rerun=range(COUNT), stop=lambda: True)
    assert files(tmp_path / "c") == files(first[0].out)  # until it is flown, what was stays


@pytest.mark.parametrize("killed", ["campaign", "worker"])
def test_what_is_killed_loses_nothing(first, study, tmp_path, killed):
    """A worker, or the campaign, which is resumed: by two the same files as by one."""
    process = start(study, tmp_path, "--workers", 2)
    wait_until(lambda: flown(tmp_path) >= 2)
    children = psutil.Process(process.pid).children(recursive=True)
    if killed == "worker":
        max(children, key=lambda child: child.cpu_times().user).kill()  # one that flies
    else:
        process.kill()
        process.communicate()
        assert 2 <= flown(tmp_path) < COUNT
        psutil.wait_procs(children, timeout=30.0)
        assert not any(child.is_running() for child in children)
        process = start(study, tmp_path, "--workers", 2)
    _, told = process.communicate(timeout=120)
    assert process.returncode == 0, told
    assert files(tmp_path) == files(first[0].out)


def test_a_scheduler_started_separately(first, study, tmp_path):
    note = tmp_path / "scheduler.json"
    command = [sys.executable, "-m", "distributed.cli"]
    options = ["--no-dashboard", "--host", "127.0.0.1", "--port", "0"]
    scheduler = [f"{command[2]}.dask_scheduler", *options, "--scheduler-file", str(note)]
    worker = [f"{command[2]}.dask_worker", "--scheduler-file", str(note), "--nthreads", "1"]
    worker += ["--no-dashboard", "--local-directory", str(tmp_path / "dask")]
    with contextlib.ExitStack() as stack:
        for arguments in (scheduler, worker, worker):
            # Not from the checkout: before Python 3.11 it would come before what is installed.
            process = subprocess.Popen(
                [*command[:2], *arguments],
                cwd=tmp_path,
                stderr=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
            stack.callback(process.wait, 30)
            stack.callback(process.terminate)
            wait_until(note.exists)
        address = json.loads(note.read_text())["address"]
        result = campaign(read_study(study), tmp_path / "out", scheduler_address=address)
        assert not result.failed
        assert files(tmp_path / "out") == files(first[0].out)
        again = {"scheduler_address": address, "rerun": [1]}
        campaign(read_study(study), tmp_path / "out", **again)
        assert files(tmp_path / "out") == files(first[0].out)


def test_ctrl_c_keeps_what_is_done(first, study, tmp_path):
    process = start(study, tmp_path, "--workers", 1)
    wait_until(lambda: flown(tmp_path) >= 1)
    os.killpg(process.pid, signal.SIGINT)
    shown, told = process.communicate(timeout=60)
    assert process.returncode == INTERRUPTED
    assert "interrupted" in told.splitlines()[-1] and "Traceback" not in told
    assert "Safe terrain found" in shown
    assert json.loads((tmp_path / "campaign.json").read_text())["interrupted"]
    assert files(tmp_path).items() <= files(first[0].out).items()
    assert flown(tmp_path) < COUNT


def test_a_failed_flight_is_recorded_and_the_others_go_on(tmp_path):
    text = STUDY.replace("duration: 1", "duration: [1, 0.5]").replace("flights: 4", "flights: 1")
    path = written(tmp_path, text)
    out = tmp_path / "out"
    result = campaign(read_study(path), out, workers=1)
    assert sorted(result.failed) == [2, 3] and "duration" in result.failed[2]
    assert "flight 2 failed" in result.table()
    assert "flight 2" not in result.table().replace("flight 2 failed", "")
    written_at = {path: path.stat().st_mtime_ns for path in out.glob("flights/*.json")}
    again = start(path, out, "--workers", 1)
    assert again.wait(60) == 3  # nothing was flown: failures stay
    assert {path: path.stat().st_mtime_ns for path in out.glob("flights/*.json")} == written_at


def test_a_flight_is_flown_again_and_kept(first, study):
    done = start(study, first[0].out, "--keep", 3)
    shown, told = done.communicate(timeout=120)
    assert done.returncode == 0, told
    kept = first[0].out / "kept" / "000003"
    assert str(kept) in shown
    found = json.loads((kept / "evaluation" / "evaluation.json").read_text())
    figures = first[0].records[3].figures
    assert found["elevation"]["mean_absolute"] == figures["mean_absolute"]
    assert (kept / "evaluation" / "report.html").exists()
    assert (kept / "results" / "report.html").exists() and list((kept / "bag").iterdir())
