# SPDX-License-Identifier: Apache-2.0
"""Leaves of whole flights against the ground they were flown over.

Also over terrain that others measured, where its files are at hand.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from quadtree_lss.api import Mapper, load_config, scans
from quadtree_lss.lab.simulation.simulate import simulate

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FLIGHTS = {
    "parabola": ("parabola", ["parabola"], None, None),
    "parabola, fixed": ("parabola", ["parabola", "parabola_fixed"], None, None),
    "morpheus": ("morpheus", ["morpheus"], 5.0, None),
    "descent": ("descent", ["default"], 6.0, None),
    "apollo15": ("descent", ["default"], 6.0, DATA / "apollo15.npz"),
    "marsyard2021": ("descent", ["morpheus"], 6.0, DATA / "marsyard2021.npz"),
}


def errors(truth, cells):
    """Of each leaf (M,): mean error of its heights over the ground it knows, m, and what it claims
    for the middle of that; NaN where it knows none, or the truth ends."""
    ground = RegularGridInterpolator(
        (truth["y"], truth["x"]), truth["elevation"].astype(float), bounds_error=False
    )
    row, column = np.nonzero(cells.known)
    side, leaf = cells.domain.finest_size, cells.leaf_raster()[row, column]
    x, y = cells.domain.xmin + side * (column + 0.5), cells.domain.ymin + side * (row + 0.5)
    place = side * ((np.arange(12) + 0.5) / 12.0 - 0.5)
    around = y[:, None, None] + place[:, None], x[:, None, None] + place
    true = ground(np.stack(np.broadcast_arrays(*around), axis=-1)).mean(axis=(1, 2))
    with np.errstate(invalid="ignore"):
        count = np.bincount(leaf, minlength=len(cells.z))
        means = [np.bincount(leaf, of, len(cells.z)) / count for of in (x, y, true)]
        height = np.bincount(leaf, cells.at(x, y).height, len(cells.z)) / count
    return height - means[2], cells.at(means[0], means[1]).deviation


@pytest.mark.quick("parabola")
@pytest.mark.parametrize("flight", FLIGHTS)
def test_no_measured_leaf_is_off_its_ground_by_more_than_it_says(flight, tmp_path):
    """By four of its published deviations and by 0.1 m."""
    scenario, configurations, duration, terrain = FLIGHTS[flight]
    if terrain is not None and not terrain.exists():
        pytest.skip(f"{terrain.name} is not at hand")
    simulate(scenario, tmp_path / "bag", seed=11, duration=duration, terrain=terrain)
    config = load_config(configurations)
    mapper = Mapper(config)
    for scan in scans(tmp_path / "bag", config):
        mapper.update(scan.points_lidar, scan.pose, scan.sweep)
    cells = mapper.snapshot()
    with np.load(tmp_path / "truth.npz") as truth:
        error, deviation = errors(truth, cells)
    judged = cells.measured & np.isfinite(error)
    assert judged.sum() > 100
    wrong = judged & (np.abs(error) > 0.1) & (np.abs(error) > 4.0 * deviation)
    assert not wrong.any(), list(zip(cells.x[wrong], cells.y[wrong], error[wrong], strict=True))
