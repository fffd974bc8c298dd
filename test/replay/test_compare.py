# SPDX-License-Identifier: Apache-2.0
"""Two results compared without truth: made ground with a known change between them."""

import json

import numpy as np
import pytest
from replay.test_cli import run
from scipy.ndimage import gaussian_filter

from quadtree_lss.desk.exchange.dem import ElevationModel
from quadtree_lss.desk.exchange.saved import ResultsError, load_results
from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.differences import compare_results
from quadtree_lss.desk.replay.elevation_model import rank_sites

VALUES = {"lss.grid_spacing": 0.5, "lidar.range_noise": 0.02, "lss.sites": 3}
VALUES |= {"lss.assessment": "touchdown"}
CONFIG = load_config((), VALUES)


def ground(rise=0.0, boulder=None, moved=0.0):
    """32 x 32 m of gentle, uneven ground; the smoothest of it about (6, 6)."""
    x = np.arange(0.0, 32.01, 0.25)
    away = np.hypot(x - 6.0, x[:, None] - 6.0)
    z = rise + 0.01 * away * np.sin(1.3 * x) * np.cos(1.1 * x[:, None])
    if boulder is not None:
        z = z + 0.8 * (np.hypot(x - boulder[0], x[:, None] - boulder[1]) < 0.6)
    return ElevationModel(x + moved, x + moved, z)


@pytest.fixture(scope="module")
def before(tmp_path_factory):
    return rank_sites(ground(), tmp_path_factory.mktemp("a"), CONFIG, report=False).out


def test_a_result_is_itself(before):
    found = compare_results(before, before)
    assert found.heights.rms == found.heights.greatest == found.gained == found.lost == 0.0
    assert found.sites_kept == ((1, 1), (2, 2), (3, 3))
    assert not found.sites_gained and not found.sites_lost and found.heights.beyond == 0.0


def test_a_boulder_and_a_rise_are_found(before, tmp_path):
    x, y, _ = load_results(before).positions[0]
    changed = ground(rise=0.1, boulder=(x, y))
    rank_sites(changed, tmp_path / "b", CONFIG, report=False)
    found = compare_results(before, tmp_path / "b")
    h = found.heights
    assert h.mean == pytest.approx(0.1, abs=0.005) and h.greatest == pytest.approx(0.9, abs=1e-6)
    assert np.hypot(h.x - x, h.y - y) < 1.0
    assert 0.0 < h.beyond < 0.01 and h.rms_mean_removed < 0.1
    # Nobody can land where the boulder lies under the lander.
    assert found.lost == pytest.approx(np.pi * (1.85 + 0.6 + 0.25) ** 2, rel=0.15)
    assert found.gained == 0.0
    lost = found.sites_lost[0]
    assert lost.rank == 1 and lost.elsewhere.startswith("not allowed in the second (")
    assert len(found.sites_gained) == len(found.sites_lost) == 3 - len(found.sites_kept)
    assert found.sites_gained[0].elsewhere == "allowed in the first, but others rank before it"


def test_two_grounds_are_not_compared_as_one(before, tmp_path, capsys):
    """Level ground is the same whatever its noise; the shape of another is not."""
    other = ground()
    away = np.random.default_rng(7105).permutation(other.elevation.ravel())
    shape = gaussian_filter(away.reshape(other.elevation.shape), 4.0) * 40.0
    rank_sites(ElevationModel(other.x, other.y, shape), tmp_path / "b", CONFIG, report=False)
    code, out, err = run(capsys, "compare", before, tmp_path / "b", "--json")
    assert code == 1 and json.loads(out)["same_ground"] is False and "not of the same" in err
    flat = ElevationModel(other.x, other.y, 0.01 * away.reshape(shape.shape))
    rank_sites(flat, tmp_path / "flat", CONFIG, report=False)
    level = ElevationModel(other.x, other.y, 0.0 * shape)
    rank_sites(level, tmp_path / "level", CONFIG, report=False)
    assert run(capsys, "compare", tmp_path / "flat", tmp_path / "level")[0] == 0
    assert run(capsys, "compare", before, before)[0] == 0


def test_another_grid_and_domain(before, tmp_path):
    finer = load_config((), {**VALUES, "lss.grid_spacing": 0.25})
    rank_sites(ground(moved=8.0), tmp_path / "b", finer, report=False)
    found = compare_results(before, tmp_path / "b")
    side = 24.0
    assert found.heights.points * 0.25 == pytest.approx(side**2, rel=0.06)
    assert found.seen_first == pytest.approx(32.0**2 - side**2, rel=0.06)
    assert found.seen_second == pytest.approx(32.0**2 - side**2, rel=0.06)
    places = load_results(before).positions
    outside = {k for k, (x, y, _) in enumerate(places, start=1) if min(x, y) < 7.75}
    told = {s.rank for s in found.sites_lost if s.elsewhere == "outside the second's domain"}
    assert told == outside and outside


def test_no_ground_in_common_is_one_line(before, tmp_path):
    rank_sites(ground(moved=500.0), tmp_path / "b", CONFIG, report=False)
    with pytest.raises(ResultsError, match="no ground in common"):
        compare_results(before, tmp_path / "b")


def test_the_command_tells_it_in_words(before, tmp_path, capsys):
    rank_sites(ground(rise=0.1), tmp_path / "b", CONFIG, report=False)
    code, out, _ = run(capsys, "compare", before, tmp_path / "b")
    assert code == 0 and "+0.100 m" in out and "Sites kept: 1 -> 1" in out
    shown = json.loads(run(capsys, "compare", before, tmp_path / "b", "--json", "-q")[1])
    assert shown["heights"]["mean"] == pytest.approx(0.1) and len(shown["sites_kept"]) == 3
