# SPDX-License-Identifier: Apache-2.0
"""Claimed and true errors of the map of a hovering lander with persistent pose errors.

Flat ground seen from 100 m, 20 scans a second, pose errors of 0.3 m and 2 mrad along and about
each axis, as claimed: independent from scan to scan (white), constant, or Gauss-Markov. The
correlation time is the errors' own. Ratios are root mean square over flights and cells; calibrated
is 1, required 0.5 .. 1.5.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import machine, table
from common.as_posed import lengths

from quadtree_lss.onboard.config.settings import config_from_values
from quadtree_lss.onboard.core.geometry.rotations import exp
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose

HEIGHT, RATE = 100.0, 20.0
SIGMA = np.array([0.3] * 3 + [0.002] * 3)
NOISE = 0.05
DOWN = np.diag([1.0, -1.0, -1.0])
#: Kinds of errors by their correlation time, s.
KINDS = {"white": 0.0, "Gauss-Markov 100 s": 100.0, "constant": 1e6}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flights", type=int, default=12)
    parser.add_argument("--scans", type=int, nargs="+", default=[100, 1000, 10000])
    options = parser.parse_args()
    print(machine())
    rows = []
    seeds = range(901, 901 + options.flights)
    counts = sorted(options.scans)
    for kind, correlation_time in KINDS.items():
        flights = np.array([hover(hover_mapper(correlation_time), seed, counts) for seed in seeds])
        for at, scans in enumerate(counts):
            error, claimed = flights[:, at, 0], flights[:, at, 1]
            tilt, height = rms_slope_height(error)
            claimed_tilt, claimed_height = rms_slope_height(claimed)
            ratio_tilt, ratio_height = rms_slope_height(error / claimed)
            rows.append(
                [kind if at == 0 else "", f"{scans:,}"]
                + [f"{height:.3f}", f"{claimed_height:.3f}", f"{ratio_height:.2f}"]
                + [f"{1e3 * tilt:.2f}", f"{1e3 * claimed_tilt:.2f}", f"{ratio_tilt:.2f}"]
            )
    table(
        f"{options.flights} flights, seeds {seeds[0]} to {seeds[-1]}",
        ["errors", "scans", "height m", "claimed", "ratio"] + ["slope mrad", "claimed", "ratio"],
        rows,
    )


def rms_slope_height(values: np.ndarray) -> tuple[float, float]:
    """Root mean squares of (flights, cells, 3): of slopes and of heights."""
    square = np.mean(values**2, axis=(0, 1))
    return float(np.sqrt(0.5 * (square[0] + square[1]))), float(np.sqrt(square[2]))


def hover_mapper(correlation_time: float) -> Mapper:
    """Make a mapper of 16 cells of 4 m."""
    domain = {"xmin": -8.0, "ymin": -8.0, "size": 16.0, "min_level": 2, "max_level": 2}
    values = {f"domain.{name}": value for name, value in domain.items()}
    values |= {"lidar.range_noise": NOISE, "pose.correlation_time": correlation_time}
    with lengths(outlier_gate=0.0, feature_height=math.inf):
        return Mapper(config_from_values(values))


def hover(mapper: Mapper, seed: int, counts: list[int]) -> np.ndarray:
    """Errors and claimed standard deviations (counts, 2, cells, 3) after ``counts`` scans, rad,
    m."""
    rng = np.random.default_rng(seed)
    covariance = np.diag(SIGMA**2)
    position = np.array([0.0, 0.0, HEIGHT])
    tau = mapper.config.pose.correlation_time
    decay = np.exp(-1.0 / (RATE * tau)) if tau > 0.0 else 0.0
    error = SIGMA * rng.standard_normal(6)
    found = []
    for scan in range(1, counts[-1] + 1):
        # The true position is the estimated one minus the error.
        ground = np.column_stack([16.0 * rng.random((400, 2)) - 8.0, np.zeros(400)])
        turn = exp(error[3:])
        seen = (ground - (position - error[:3])) @ turn.T @ DOWN
        distance = np.linalg.norm(seen, axis=1, keepdims=True)
        seen *= 1.0 + NOISE * rng.standard_normal(distance.shape) / distance
        mapper.update(seen, Pose(round(1e9 * scan / RATE), position, DOWN, covariance))
        error = decay * error + np.sqrt(1.0 - decay * decay) * SIGMA * rng.standard_normal(6)
        if scan in counts:
            cells = mapper.snapshot()
            off = np.column_stack([cells.normal[:, :2], cells.z])
            found.append([off, np.sqrt(np.einsum("mii->mi", cells.covariance))])
    return np.array(found)


if __name__ == "__main__":
    main()
