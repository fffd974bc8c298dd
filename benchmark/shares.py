# SPDX-License-Identifier: Apache-2.0
"""Errors of partly observed leaves over their claimed standard deviations.

Each leaf of 0.25 to 8 m, which may divide down to 0.25 m, is scanned in a straight strip of random
share, direction and position, at incidences of 0 to 75 degrees, with 5 to 5,000 points per scan, 6
cm range noise and an exact pose. The ground is a plane, with ``--rolling`` also waves of 12 to 60
m, or with ``--terrain`` measured ground. The ratios are those of the mean height of the observed
part and of the slopes of the whole leaf along the axes of its covariance. A calibrated map has a
root mean square of 1 and almost no ratio beyond 4.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import machine, table
from common.as_posed import lengths
from common.claims import Claims, Surface, claims, summary
from common.rays import EXACT, looking

from quadtree_lss.lab.simulation.terrain import Terrain, load_terrain
from quadtree_lss.onboard.arrays import Array
from quadtree_lss.onboard.config.settings import Config, config_from_values
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose

NOISE = 0.06
#: Shortest and longest waves of rolling ground, m, and how many there are.
WAVES = (12.0, 60.0, 8)
#: Smallest distance of a place on measured ground from the edge, m.
EDGE_DISTANCE = 12.5
#: Sides of the coarse leaf, m.
SIDES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)


@dataclass(frozen=True)
class Draw:
    """A random leaf: its observed share, the number of scans, and the claims of its final
    leaves."""

    share: float
    scans: int
    found: Claims


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=4000, help="leaves of one scan")
    parser.add_argument("--of-twenty", type=int, default=1000, help="leaves of twenty scans")
    parser.add_argument("--seed", type=int, default=4510)
    text = "root mean square slope of waves, degrees"
    parser.add_argument("--rolling", type=float, default=0.0, help=text)
    parser.add_argument("--terrain", type=Path, help=".npz of measured ground")
    options = parser.parse_args()
    print(machine())
    counts = {1: options.draws, 20: options.of_twenty}
    of = math.tan(math.radians(options.rolling))
    relief = of if options.terrain is None else load_terrain(options.terrain)
    found = [d for scans, n in counts.items() for d in draw_leaves(options.seed, n, scans, relief)]
    rows = []
    for scans in (1, 20):
        rows.append([f"{scans}, all", *row_of([d for d in found if d.scans == scans])])
    rows.append(["all", *row_of(found)])
    three = ["RMS", "over 4, %", "worst"]
    table(
        "error over claimed deviation: height at the middle of what was seen, slope, both",
        ["scans, and which", "draws", "measured", *3 * three],
        rows,
    )


def row_of(draws: list[Draw]) -> list[object]:
    """Numbers of draws and of estimated leaves, and statistics of their ratios."""
    out: list[object] = [len(draws), sum(len(d.found.height) for d in draws)]
    for of in ("height", "slope", "all"):
        ratios = pooled(draws, of)
        if not len(ratios):
            out += ["-"] * 3
            continue
        rms, beyond, worst = summary(ratios)
        out += [f"{rms:.2f}", f"{100 * beyond:.2f}", f"{worst:.1f}"]
    return out


def pooled(draws: list[Draw], of: str = "all") -> Array:
    """Ratios of ``height``, ``slope`` or ``all`` in one array."""
    return np.concatenate([np.zeros(0), *(getattr(d.found, of).ravel() for d in draws)])


def one_leaf(side: float) -> Config:
    """Configuration of a domain of one leaf that may divide down to 0.25 m."""
    domain = {"xmin": 0.0, "ymin": 0.0, "size": side, "min_level": 0}
    domain["max_level"] = round(np.log2(side / 0.25))
    values: dict[str, object] = {f"domain.{name}": value for name, value in domain.items()}
    return config_from_values(values | {"lidar.range_noise": NOISE})


def draw_leaves(seed: int, draws: int, scans: int, relief: float | Terrain = 0.0) -> list[Draw]:
    """Draw leaves with a number of scans each, over waves or a terrain as in `ground`."""
    return [
        scan_strip(np.random.default_rng([seed, scans, k]), scans, relief) for k in range(draws)
    ]


def ground(
    gradient: tuple[float, float], relief: float | Terrain, rng: np.random.Generator
) -> Surface:
    """Plane with waves of a root mean square slope, or with a terrain."""
    if isinstance(relief, Terrain):
        return terrain_surface(relief, gradient, rng)
    if relief == 0.0:
        return lambda x, y: gradient[0] * x + gradient[1] * y
    number = 2.0 * np.pi / np.geomspace(*WAVES)
    heading, phase = rng.uniform(0.0, 2.0 * np.pi, (2, WAVES[2]))
    high = relief * np.sqrt(2.0 / WAVES[2]) / number

    def surface(x: Array, y: Array) -> Array:
        along = x[..., None] * np.cos(heading) + y[..., None] * np.sin(heading)
        waves = np.sin(number * along + phase) @ high
        return gradient[0] * x + gradient[1] * y + waves

    return surface


def terrain_surface(
    terrain: Terrain, gradient: tuple[float, float], rng: np.random.Generator
) -> Surface:
    """Terrain around a random place, rotated and relative to its height there, on a plane."""
    low_x, high_x, low_y, high_y = terrain.bounds
    place = rng.uniform(
        [low_x + EDGE_DISTANCE, low_y + EDGE_DISTANCE],
        [high_x - EDGE_DISTANCE, high_y - EDGE_DISTANCE],
    )
    turn = rng.uniform(0.0, 2.0 * np.pi)
    level = terrain.elevation_at(*place)

    def surface(x: Array, y: Array) -> Array:
        u = place[0] + np.cos(turn) * x - np.sin(turn) * y
        v = place[1] + np.sin(turn) * x + np.cos(turn) * y
        return terrain.elevation_at(u, v) - level + gradient[0] * x + gradient[1] * y

    return surface


def scan_strip(rng: np.random.Generator, scans: int, relief: float | Terrain = 0.0) -> Draw:
    """Scan a random strip of a random leaf, each scan with its own points."""
    side = float(rng.choice(SIDES))
    share, incidence = rng.uniform(0.01, 1.0), rng.uniform(0.0, 75.0)
    share = share if rng.random() < 0.8 else rng.uniform(0.01, 0.1)
    gradient = tuple(rng.uniform(-0.2, 0.2, 2))
    count = int(np.exp(rng.uniform(np.log(5.0), np.log(5000.0))) / (1 if scans == 1 else 4)) + 3
    turn, azimuth = rng.uniform(0.0, 2.0 * np.pi, 2)
    across = np.array([np.cos(turn), np.sin(turn)])
    # Lines between which the strip contains this share of the leaf.
    start = rng.choice([0.0, rng.random(), 1.0]) * (1.0 - share)
    low, high = np.quantile(rng.uniform(0.0, side, (4000, 2)) @ across, [start, start + share])
    low, high = (-np.inf if start <= 0.0 else low), (np.inf if start + share >= 1.0 else high)
    normal = np.array([-gradient[0], -gradient[1], 1.0])
    normal /= np.linalg.norm(normal)
    # A ray that meets the ground at this incidence.
    axis = looking(np.zeros(3), -normal)
    tilted = np.tan(np.radians(incidence)) * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    back = axis @ (tilted - [0.0, 0.0, 1.0])
    middle = np.array([0.5 * side, 0.5 * side, 0.5 * side * sum(gradient)])
    position = middle + rng.uniform(100.0, 300.0) * back / np.linalg.norm(back)
    axes = looking(position, middle)
    with lengths(outlier_gate=0.0, feature_height=math.inf):
        mapper = Mapper(one_leaf(side))
    surface = ground(gradient, relief, rng)
    for k in range(scans):
        # Noise moves points across the edge of the leaf.
        margin = 0.3
        number = rng.poisson(count / share * (1.0 + 2.0 * margin / side) ** 2)
        places = rng.uniform(-margin, side + margin, (min(number, 100_000), 2))
        places = places[(places @ across >= low) & (places @ across <= high)]
        to = np.column_stack([places, surface(*places.T)]) - position
        to *= 1.0 + NOISE * rng.standard_normal((len(to), 1)) / np.linalg.norm(
            to, axis=1, keepdims=True
        )
        mapper.update(to @ axes, Pose(round(1e9 + 5e7 * k), position, axes, EXACT))
    return Draw(share, scans, claims(mapper.snapshot(), surface))


if __name__ == "__main__":
    main()
