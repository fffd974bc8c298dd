# SPDX-License-Identifier: Apache-2.0
"""Two results compared without truth: made ground with a known change between them."""

import json

import numpy as np
import pytest
from replay.test_cli import run

from quadtree_lss.desk.exchange.dem import ElevationModel
from quadtree_lss.desk.exchange.saved import load_results
from quadtree_lss.desk.replay.configuration import load_config
from quadtree_lss.desk.replay.differences import compare_results
from quadtree_lss.desk.replay.elevation_model import rank_sites

pytestmark = pytest.mark.xdist_group("compare")  # its flight is made once

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


def test_the_command_tells_it_in_words(before, tmp_path, capsys):
    rank_sites(ground(rise=0.1), tmp_path / "b", CONFIG, report=False)
    code, out, _ = run(capsys, "compare", before, tmp_path / "b")
    assert code == 0 and "+0.100 m" in out and "Sites kept: 1 -> 1" in out
    shown = json.loads(run(capsys, "compare", before, tmp_path / "b", "--json", "-q")[1])
    assert shown["heights"]["mean"] == pytest.approx(0.1) and len(shown["sites_kept"]) == 3
