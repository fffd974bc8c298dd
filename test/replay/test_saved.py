# SPDX-License-Identifier: Apache-2.0
"""Results read back from their folder, plotted, and a bag mapped scan by scan."""

import numpy as np
import pytest
from replay.recordings import GROUND

from quadtree_lss.api import (
    ResultsError,
    load_config,
    load_results,
    replay,
    steps,
)
from quadtree_lss.onboard.messages.maps import known_probability

#: So few returns say little.
CONFIG = load_config((), {**GROUND, "domain.max_level": 5, "lss.max_risk": 0.5})


@pytest.fixture(scope="module")
def written(bag, tmp_path_factory):
    return replay(bag, tmp_path_factory.mktemp("out"), CONFIG, report=False)


def test_everything_comes_back(written):
    results = load_results(written.out)
    cells, found = written.cells, written.assessment
    columns = "level ix iy z normal count measured feature low high observed known"
    for name in columns.split():
        np.testing.assert_array_equal(getattr(results.map, name), getattr(cells, name), name)
    for name in ("covariance_range", "covariance_pose"):
        one, other = getattr(results.map, name), getattr(cells, name)
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-15)
    assert results.map.stamp_ns == cells.stamp_ns and results.map.domain == cells.domain
    np.testing.assert_array_equal(results.map.offset_z, cells.offset_z)
    for name, layer in results.grid.layers.items():
        told = known_probability(found) if name == "probability" else getattr(found, name)
        np.testing.assert_array_equal(layer, told, name)
    assert results.grid.spacing == CONFIG.lss.spacing
    np.testing.assert_array_equal(results.positions, found.sites.position)
    assert results.sites["rank"].dtype == np.int64
    assert results.timing["stamp_ns"].tolist() == [row.stamp_ns for row in written.timings]
    assert results.selected["reason"].tolist() == [row.reason for row in written.targets]
    assert results.config == CONFIG and results.summary["scans"] == 6
    assert "6 scans" in repr(results) and len(repr(results.grid)) < 300


def test_what_is_no_results_folder_is_said(written, tmp_path):
    with pytest.raises(ResultsError, match="not a results folder"):
        load_results(tmp_path / "none")
    with pytest.raises(ResultsError, match="no summary.json"):
        load_results(tmp_path)


FILES = {"cells.npz": "map", "grid.npz": "grid", "summary.json": "summary", "sites.csv": "sites"}


@pytest.mark.parametrize(("name", "attribute"), FILES.items())
def test_a_damaged_file_is_named(written, tmp_path, name, attribute):
    for path in written.out.iterdir():
        if path.is_file():
            (tmp_path / path.name).write_bytes(path.read_bytes())
    content = (tmp_path / name).read_bytes()
    other = b"[1]" if "json" in name else b"a\n1,2"
    for damaged in (content[: len(content) // 2], b"\x80\xff", other):
        (tmp_path / name).write_bytes(damaged)
        with pytest.raises(ResultsError, match=f"{name}: cannot be read"):
            getattr(load_results(tmp_path), attribute)


def test_scan_by_scan_is_the_replay(bag, written):
    seen = [(step.scan.stamp_ns, step.report.leaves) for step in steps(bag, CONFIG)]
    assert seen == [(row.stamp_ns, row.leaves) for row in written.timings]
    *_, last = steps(bag, CONFIG)
    np.testing.assert_array_equal(last.mapper.snapshot().level, written.cells.level)
    assert len(repr(written)) < 400
