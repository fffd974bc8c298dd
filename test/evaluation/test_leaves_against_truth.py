# SPDX-License-Identifier: Apache-2.0
"""Leaves of whole flights against the ground they were flown over.

Also over terrain that others measured, where its files are at hand.
"""

from pathlib import Path

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from quadtree_lss.api import Mapper, load_config, scans
from quadtree_lss.simulation.simulate import simulate

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"
FLIGHTS = {
    "parabola": ("parabola", ["parabola"], None, None),
    "parabola, fixed": ("parabola", ["parabola", "parabola_fixed"], None, None),
    "morpheus": ("morpheus", ["morpheus"], 5.0, None),
    "descent": ("descent", ["default"], 6.0, None),
    "apollo15": ("descent", ["default"], 6.0, DATA / "apollo15.npz"),
    "marsyard2021": ("descent", ["morpheus"], 6.0, DATA / "marsyard2021.npz"),
}


def ground_means(truth, cells):
    """Mean elevation (M,) of the true ground under each leaf, NaN where it ends within."""
    ground = RegularGridInterpolator(
        (truth["y"], truth["x"]), truth["elevation"].astype(float), bounds_error=False
    )
    place = (np.arange(12) + 0.5) / 12.0 - 0.5
    x = cells.x[:, None, None] + cells.size[:, None, None] * place
    y = cells.y[:, None, None] + cells.size[:, None, None] * place[:, None]
    return ground(np.stack(np.broadcast_arrays(y, x), axis=-1)).mean(axis=(1, 2))


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
        error = cells.z - ground_means(truth, cells)
    deviation = np.sqrt(cells.covariance[:, 2, 2]) / cells.normal[:, 2]
    judged = cells.measured & np.isfinite(error)
    assert judged.sum() > 100
    wrong = judged & (np.abs(error) > 0.1) & (np.abs(error) > 4.0 * deviation)
    assert not wrong.any(), list(zip(cells.x[wrong], cells.y[wrong], error[wrong], strict=True))
