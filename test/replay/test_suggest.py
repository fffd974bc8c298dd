# SPDX-License-Identifier: Apache-2.0
"""``config suggest``: domain, noise and cells that fit a bag."""

import json

import numpy as np
import pytest
from replay.test_cli import run

from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.replay import replay
from quadtree_lss.desk.replay.suggest import suggest_config
from quadtree_lss.lab.simulation.simulate import simulate

pytestmark = pytest.mark.xdist_group("suggest")  # its flight is made once


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Far from the default domain, with another noise than the default's."""
    folder = tmp_path_factory.mktemp("flight")
    x, y = 300.0 + np.arange(0.0, 60.0, 0.5), -200.0 + np.arange(0.0, 60.0, 0.5)
    rolling = 2.0 * np.sin(x / 9.0) + np.cos(y / 7.0)[:, None]
    np.savez(folder / "dem.npz", x=x, y=y, elevation=rolling)
    terrain = folder / "dem.npz"
    simulate("descent", folder / "bag", seed=9, duration=4.0, terrain=terrain, range_noise=0.03)
    return folder / "bag"


def test_a_flight_can_be_replayed_with_what_is_suggested(flight, tmp_path):
    found = suggest_config(flight, load_config())
    values = found.values
    assert values["lidar.range_noise"] == pytest.approx(0.03, rel=0.15)
    low = np.array([values["domain.xmin"], values["domain.ymin"]])
    assert (low < (305.0, -195.0)).all() and (low + values["domain.size"] > (355, -145)).all()
    assert 40.0 < values["domain.size"] < 80.0
    assert 0.2 < values["domain.size"] / 2 ** values["domain.max_level"] < 1.5
    path = tmp_path / "mine.yaml"
    path.write_text(found.text())
    config = load_config([path], {"lss.max_risk": 0.2})  # a second of flight
    result = replay(flight, None, config)
    assert result.summary["points_used"] > 0.9 * result.summary["points"]
    assert len(result.assessment.sites) > 0
    assert not any("scatter" in line for line in result.warnings)


def test_the_command_prints_a_file_with_reasons(flight, tmp_path, capsys):
    code, out, err = run(capsys, "config", "suggest", flight)
    assert code == 0 and "# scatter" in out and "domain:" in out
    assert "Fault" not in out + err  # the default domain does not fit, the suggested one does
    (tmp_path / "mine.yaml").write_text(out)
    assert run(capsys, "config", "check", tmp_path / "mine.yaml")[0] == 0
    shown = json.loads(run(capsys, "config", "suggest", flight, "--json", "-q")[1])
    assert shown["values"] == suggest_config(flight, load_config()).values


@pytest.mark.slow
@pytest.mark.parametrize(("given", "sparse"), [("0.6,0.08", True), ("3.7,0.3", False)])
def test_cells_suit_the_vehicle(flight, tmp_path, capsys, given, sparse):
    """Returns 0.2 m apart and of 3 cm noise are too coarse for a drone of 0.6 m, which is told."""
    code, out, _ = run(capsys, "config", "suggest", flight, "--vehicle", given)
    (tmp_path / "mine.yaml").write_text(out)
    config = load_config([tmp_path / "mine.yaml"])
    diameter, clearance = map(float, given.split(","))
    assert code == 0 and config.vehicle.diameter == diameter
    assert config.vehicle.clearance == clearance
    assert config.vehicle.pad_radius == pytest.approx(0.15 * diameter / 3.7, rel=0.01)
    assert 5.0 < diameter * 2**config.domain.max_level / config.domain.size < 18.0
    assert ("too coarse for a vehicle of" in out) == sparse
    assert run(capsys, "config", "suggest", flight, "--vehicle", "small")[0] == 2


@pytest.mark.quick("1.4")
@pytest.mark.parametrize("diameter", [1.4, 2.0, 2.5, 3.0, 3.7, 6.0])
def test_it_keeps_what_is_given_and_asks_for_no_cells_that_no_risk_was_fitted_to(flight, diameter):
    given = {"vehicle.diameter": diameter, "lss.dispersion": 0.7, "mount.z": 0.001}
    found = suggest_config(flight, load_config((), given))
    assert {name: found.values[name] for name in given} == given
    finest = found.values["domain.size"] / 2 ** found.values["domain.max_level"]
    assert finest > 0.99 * diameter / 16.0
