# SPDX-License-Identifier: Apache-2.0
"""Response of the map to one pose that is wrong by many of its standard deviations.

Level ground, or hills 0.3 m high and 8 m apart, 16 m wide, is scanned from 60 m twice a second.
Pose errors are drawn from the claimed covariance, once for the flight (persistent) or for each scan
(white, with ``pose.correlation_time`` 0). The pose of the last scan has an additional error in
height or in tilt. The table shows the largest share of that error by which the map moves, over all
seeds.
"""

from __future__ import annotations

import argparse
import itertools
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

SIZE, HEIGHT, NOISE = 16.0, 60.0, 0.05
DOWN = np.diag([1.0, -1.0, -1.0])
#: Claims of position, m, and of attitude, rad.
CLAIMS = ((0.05, 0.001), (0.3, 0.002))
ERROR_FACTORS = (3, 5, 8, 20)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--before", type=int, nargs="+", default=[3, 10])
    options = parser.parse_args()
    print(machine())
    rows = [
        [ground, errors, axis, *row_of(height, options, axis == "tilt", errors == "white")]
        for ground, height in (("level", 0.0), ("hills", 0.3))
        for errors in ("persist", "white")
        for axis in ("height", "tilt")
    ]
    title = "wrong scans rejected, and the greatest share of the error that the map follows"
    table(
        title, ["ground", "errors", "off in", *(f"{factor} dev." for factor in ERROR_FACTORS)], rows
    )


def row_of(height: float, options: argparse.Namespace, tilt: bool, white: bool) -> list[str]:
    """Ranges over all claims and numbers of earlier scans."""
    row = []
    for factor in ERROR_FACTORS:
        cases = itertools.product(CLAIMS, options.before)
        found = [
            np.array(
                [
                    response(height, k, claim, factor, tilt, earlier_scans, white)
                    for k in range(options.seeds)
                ]
            ).T
            for claim, earlier_scans in cases
        ]
        rejected, share = [f[0].mean() for f in found], max(f[1].max() for f in found)
        row.append(f"{min(rejected):.0%} to {max(rejected):.0%}, {share:.3f}")
    return row


def response(
    height: float,
    seed: int,
    claim: tuple[float, float],
    factor: float,
    tilt: bool,
    earlier_scans: int,
    white: bool,
) -> tuple[bool, float]:
    """Whether the scan was rejected, and the share of its error that the map follows."""
    rng = np.random.default_rng(seed)
    sigma = np.repeat(claim, 3)
    values: dict[str, object] = {
        "domain.xmin": -0.5 * SIZE, "domain.ymin": -0.5 * SIZE, "domain.size": SIZE,
        "domain.min_level": 2, "domain.max_level": 4,
        "lidar.range_noise": NOISE,
    }  # fmt: skip
    if white:
        values["pose.correlation_time"] = 0.0
    with lengths(outlier_gate=0.0):
        mapper = Mapper(config_from_values(values))
    error = sigma * rng.standard_normal(6)
    at = np.array([0.0, 0.0, HEIGHT])

    def scan(number: int, extra_error: np.ndarray) -> bool:
        x, y = SIZE * (rng.random((2, 6000)) - 0.5)
        seen = (np.column_stack([x, y, height * np.sin(0.8 * x) * np.cos(0.7 * y)]) - at) @ DOWN
        distance = np.linalg.norm(seen, axis=1, keepdims=True)
        seen *= 1.0 + NOISE * rng.standard_normal(distance.shape) / distance
        pose = Pose(
            500_000_000 * (number + 1),
            at + extra_error[:3],
            exp(extra_error[3:]) @ DOWN,
            np.diag(sigma**2),
        )
        return mapper.update(seen, pose).points_used == 0

    for number in range(earlier_scans):
        scan(number, error)
        if white:
            error = sigma * rng.standard_normal(6)
    first = mapper.snapshot()
    extra = np.zeros(6)
    extra[3 if tilt else 2] = factor * sigma[3 if tilt else 2]
    rejected = scan(earlier_scans, error * (not white) + extra)
    last = mapper.snapshot()
    # Leaves may have been divided in between: both maps at the middles of the finest cells.
    count = first.domain.finest_count
    grid = SIZE * ((np.arange(count) + 0.5) / count - 0.5)
    places = np.meshgrid(grid, grid)
    change = last.at(*places).height - first.at(*places).height
    if tilt:
        # A turn about x raises the ground along y.
        slope = np.polyfit(grid, np.nanmedian(change, axis=1), 1)[0]
        return rejected, abs(slope) / extra[3]
    return rejected, abs(float(np.nanmedian(change))) / extra[2]


if __name__ == "__main__":
    main()
