# SPDX-License-Identifier: Apache-2.0
"""Landing sites straight on an elevation model."""

import json

import numpy as np
import pytest
from replay.test_cli import run

from quadtree_lss.desk.exchange.dem import ElevationModel
from quadtree_lss.desk.exchange.saved import load_results
from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.elevation_model import cells_of, rank_sites
from quadtree_lss.desk.report.headline import verdict

VALUES = {"lss.grid_spacing": 0.5, "lidar.range_noise": 0.02, "domain.follow": "vehicle"}
CONFIG = load_config((), VALUES)


def model(rise=0.0):
    """40 x 30 m at 0.25 m with a boulder of 0.8 m at (12, 10), steep east of x = 25; a hole."""
    x, y = np.arange(0.0, 40.01, 0.25), np.arange(0.0, 30.01, 0.25)
    z = rise * x + 0.0 * y[:, None]
    z = z + 0.8 * (np.hypot(x - 12.0, y[:, None] - 10.0) < 0.6)
    z = z + 0.6 * np.maximum(x - 25.0, 0.0)
    z[np.ix_(y > 27.0, x < 3.0)] = np.nan
    return ElevationModel(x, y, z)


@pytest.fixture
def dem_file(tmp_path):
    dem = model()
    np.savez(tmp_path / "dem.npz", x=dem.x, y=dem.y, elevation=dem.elevation)
    return tmp_path / "dem.npz"


def test_without_a_site_the_console_names_the_limit_as_the_page_does(tmp_path, capsys):
    dem = model(1.0)
    np.savez(tmp_path / "steep.npz", x=dem.x, y=dem.y, elevation=dem.elevation)
    folder = tmp_path / "out"
    code, out, _ = run(capsys, "sites", tmp_path / "steep.npz", "--out", folder, "--no-report")
    (line,) = (line for line in out.splitlines() if line.startswith("No landing site: "))
    assert code == 0 and "% " in line and "Landing is allowed on 0 %" in line
    assert line[17:].lower() == verdict(load_results(folder)).ground.lower()


def test_the_map_is_the_models_ground():
    dem = model(0.1)
    cells, block = cells_of(dem, 0.02)
    assert block == 1 and cells.domain.finest_size == 0.25
    found = cells.at([5.1, 20.0, 30.0], [5.0, 3.3, 20.0])
    np.testing.assert_allclose(found.height, [0.51, 2.0, 6.0], atol=1e-9)
    slopes = np.degrees(np.arctan([0.1, 0.1, 0.7]))
    np.testing.assert_allclose(found.slope_deg, slopes, atol=1e-9)
    assert (found.deviation > 0.009).all() and (found.deviation < 0.03).all()
    for x, y in ((1.0, 28.0), (39.0, 31.0), (41.0, 3.0)):
        assert np.isnan(cells.at(x, y).height)


def test_sites_keep_off_boulder_slope_and_hole():
    with np.errstate(invalid="raise"):  # a warning of NumPy's would reach the user
        found = rank_sites(model(), None, CONFIG).assessment
    assert len(found.sites) == 5
    x, y, _ = found.sites.position.T
    assert (np.hypot(x - 12.0, y - 10.0) > 1.85).all() and (x < 26.0).all()
    safe = {(a, b) for b, a in np.argwhere(found.safe)}
    places = {"open": (18.0, 20.0), "boulder": (12.0, 10.0), "steep": (32.0, 15.0)}
    places["hole"] = (1.5, 28.5)
    at = {name: (round(a / 0.5), round(b / 0.5)) for name, (a, b) in places.items()}
    assert at["open"] in safe and not {at["boulder"], at["steep"], at["hole"]} & safe


def test_an_area_cuts_the_model_and_a_target_is_near():
    area = [[15.0, 15.0], [24.0, 15.0], [24.0, 25.0], [15.0, 25.0]]
    found = rank_sites(model(), None, CONFIG, landing={"area": area, "target": [17.5, 23.0]})
    x, y, _ = found.assessment.sites.position.T
    assert len(x) and (x > 15.0).all() and (x < 24.0).all() and (y > 15.0).all()
    assert found.cells.domain.xmin > 10.0


@pytest.mark.slow
def test_doubts_are_told_by_the_command_its_files_and_its_page(dem_file, tmp_path, capsys):
    out = tmp_path / "out"
    options = ["--set", "vehicle.max_slope_deg=25", "--set", "lss.grid_spacing=1", "--out", out]
    code, _, err = run(capsys, "sites", dem_file, *options)
    told = "was fitted for a slope of"
    summary = json.loads((out / "summary.json").read_text())
    assert code == 0 and told in err and told in summary["doubts"][0]
    assert summary["warnings"][: len(summary["doubts"])] == summary["doubts"]
    assert told in (out / "report.html").read_text()


def test_the_command_writes_results_like_a_replay(dem_file, tmp_path, capsys):
    options = ["--set", "lss.grid_spacing=0.5", "--out", tmp_path / "out"]
    code, out, _ = run(capsys, "sites", dem_file, *options)
    assert code == 0 and "161 x 121 posts, 0.25 m apart; heights 0.0 to 9.0 m" in out
    assert "median slope 0.0°" in out
    assert out.splitlines()[-1] == f"open {tmp_path / 'out' / 'report.html'}"
    results = load_results(tmp_path / "out")
    assert results.selected["reason"].tolist() == ["first"]
    assert results.selected["x"][0] == results.positions[0, 0]
    assert len(results.positions) == 5 and results.map.at(18.0, 20.0).height == pytest.approx(0.0)
    shown = json.loads(run(capsys, "sites", dem_file, *options, "--json", "-q")[1])
    assert len(shown["sites"]) == 5 and shown["posts"] == [161, 121]
