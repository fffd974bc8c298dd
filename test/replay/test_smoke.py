# SPDX-License-Identifier: Apache-2.0
"""Every command with every shipped configuration, on a small simulated flight."""

import json
from pathlib import Path

import pytest

from quadtree_lss.cli import main
from quadtree_lss.desk.replay.configuration import find_config
from quadtree_lss.lab.simulation.simulate import simulate

pytestmark = pytest.mark.xdist_group("smoke")  # its flight is made once

SHIPPED = sorted(path.stem for path in Path(find_config("default")).parent.glob("*.yaml"))


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flight")
    simulate("parabola", folder / "bag", seed=5, duration=4.0)
    simulate("depth", folder / "depth" / "bag", seed=5, duration=1.6)
    return folder


def run_all(capsys, *commands):
    for arguments in commands:
        assert main([str(argument) for argument in arguments]) == 0, arguments
        shown, err = capsys.readouterr()
        assert shown and "Traceback" not in err


@pytest.mark.quick("default", "depth_camera")
@pytest.mark.parametrize("name", SHIPPED)
def test_each_command_with_each_shipped_configuration(flight, tmp_path, capsys, name):
    out, chosen = tmp_path / "out", ["--config", name]
    flight = flight / "depth" if name == "depth_camera" else flight
    run_all(
        capsys,
        ["info", flight / "bag", *chosen],
        ["config", "check", name],
        ["config", *chosen],
        ["replay", flight / "bag", "--out", out, *chosen, "--no-report", "--record", out / "made"],
        ["replay", out / "made", "--out", out / "again", *chosen, "--no-report"],
    )
    assert json.loads((out / "summary.json").read_text())["scans"] >= 4
    assert (out / "sites.csv").read_bytes() == (out / "again" / "sites.csv").read_bytes()
