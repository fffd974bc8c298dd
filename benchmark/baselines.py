# SPDX-License-Identifier: Apache-2.0
"""Ours against a Python loop over the cells of a fixed grid, each fitted with NumPy.

On the same scans in the same run. The loops get points that are already in the map frame and
sorted out, and only fit; ours starts from the raw scan. For mean heights see `scan_update.py`.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import Recording, configuration, machine, recording, table

from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.mapping.mapper import Mapper

Scan = tuple[np.ndarray, np.ndarray]
"""Points (N, 3) in the map frame and the finest cell of each (N,)."""


def least_squares_loop(scan: Scan) -> int:
    """Height regression of each cell with ``numpy.linalg.lstsq``."""

    def fit(points: np.ndarray) -> np.ndarray:
        design = np.column_stack([points[:, :2], np.ones(len(points))])
        return np.linalg.lstsq(design, points[:, 2], rcond=None)[0]

    return _loop(scan, fit)


def svd_loop(scan: Scan) -> int:
    """Total least squares of each cell with ``numpy.linalg.svd``."""
    return _loop(scan, lambda points: np.linalg.svd(points - points.mean(axis=0))[2][2])


def _loop(scan: Scan, fit: Callable[[np.ndarray], np.ndarray]) -> int:
    points, cell = scan
    fitted = 0
    for one in np.unique(cell):
        inside = points[cell == one]
        if len(inside) >= 3:
            # Like a beginner's, but about the cell's own points, or 450 m of height cost digits.
            fit(inside - inside[0])
            fitted += 1
    return fitted


def sorted_svd_loop(scan: Scan) -> int:
    """The same after one sort, which spares the search for each cell's points."""
    points, cell = scan
    order = np.argsort(cell, kind="stable")
    bounds = np.flatnonzero(np.diff(cell[order])) + 1
    groups = [g for g in np.split(points[order], bounds) if len(g) >= 3]
    for group in groups:
        np.linalg.svd(group - group.mean(axis=0), full_matrices=False)
    return len(groups)


def main() -> None:
    """Print one table for each flight."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--scans", type=int, default=20, help="spread over the flight")
    parser.add_argument("--duration", type=float, help="s of each flight, by default all")
    options = parser.parse_args()
    print(machine())
    for scenario in ("morpheus", "parabola"):
        compare(scenario, recording(scenario, options.seed, options.duration), options.scans)


def compare(scenario: str, flight: Recording, scans: int) -> None:
    """Every method on the same scans of one flight."""
    config = configuration(scenario)
    chosen = flight.scans
    step = max(len(chosen) // scans, 1)
    chosen = chosen[::step][:scans]
    mapper = Mapper(config)
    domain = mapper.domain
    ready = []
    for scan in chosen:
        points = scan.points_lidar.reshape(-1, 3) @ scan.pose.rotation_map_lidar.T
        points = (points + scan.pose.position)[np.isfinite(points).all(axis=1)]
        ix, iy = np.floor((points[:, :2] - [domain.xmin, domain.ymin]) / domain.finest_size).T
        n = domain.finest_count
        inside = (ix >= 0) & (ix < n) & (iy >= 0) & (iy < n)
        ready.append((points[inside], (iy * n + ix)[inside]))
    fixed = Mapper(config_from_values({"domain.min_level": config.domain.max_level}, config))
    methods: list[tuple[str, Callable, list]] = [
        ("quadtree_lss", lambda scan: mapper.update(*scan[1:3]).leaves, chosen),
        ("quadtree_lss, fixed resolution", lambda scan: fixed.update(*scan[1:3]).leaves, chosen),
        ("loop over cells, lstsq", least_squares_loop, ready),
        ("loop over cells, SVD", svd_loop, ready),
        ("loop over sorted cells, SVD", sorted_svd_loop, ready),
    ]
    rows, ours = [], 0.0
    for name, method, data in methods:
        spent = []
        for scan in data:
            began = time.process_time()
            method(scan)
            spent.append(1e3 * (time.process_time() - began))
        median, worst = float(np.median(spent)), max(spent)
        ours = ours or median
        rows.append([name, f"{median:.2f}", f"{worst:.2f}", f"{median / ours:.2f}"])
    table(
        f"{scenario}, {len(chosen)} scans, finest cells {domain.finest_size:g} m, CPU ms a scan",
        ["method", "median", "worst", "times ours"],
        rows,
    )
    print("planes with covariance, division, exceptions, features: only quadtree_lss")


if __name__ == "__main__":
    main()
