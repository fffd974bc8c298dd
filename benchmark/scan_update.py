# SPDX-License-Identifier: Apache-2.0
"""CPU time of one scan update, by flight, number of points and number of leaves.

For comparison, `common/heights.py` computes mean heights on a fixed grid from the same scans.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: one core is measured

import numpy as np
from common import Recording, configuration, machine, mean_heights, recording, table

from quadtree_lss.onboard.config.settings import Config
from quadtree_lss.onboard.core.mapping.mapper import Mapper
from quadtree_lss.onboard.core.sensing.lidar import Pose

FLIGHTS = (
    ("morpheus", "Morpheus, leaves to 0.25 m"),
    ("parabola", "Section VI, to 1.875 m"),
)
POINTS = (64, 128, 256, 512, 1024)
LEVELS = (3, 4, 5, 6, 7, 8)
OURS, LOOP = "quadtree_lss", "plain compiled loop"


def cpu_ms(function: Callable[..., object], *args: object) -> float:
    """CPU time of one call, ms."""
    began = time.process_time()
    function(*args)
    return 1e3 * (time.process_time() - began)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=101)
    parser.add_argument("--duration", type=float, help="duration of each flight, s")
    parser.add_argument("--growth", action="store_true", help="also with points and leaves")
    parser.add_argument("--largest", type=int, default=POINTS[-1], help="side of the largest scan")
    options = parser.parse_args()
    print(machine())
    flights = {name: recording(name, options.seed, options.duration) for name, _ in FLIGHTS}
    for scenario, title in FLIGHTS:
        print_flight(title, flights[scenario], configuration(scenario))
    if options.growth:
        growth_with_points([side for side in POINTS if side <= options.largest])
        growth_with_leaves()


def cpu_times(mapper: Mapper, scans: list[tuple[np.ndarray, Pose]]) -> dict[str, np.ndarray]:
    """CPU time (S,) of each scan in ``mapper`` and for mean heights on its finest cells, ms."""
    methods = {OURS: mapper.update, LOOP: mean_heights(mapper.domain)}
    spent = {}
    for name, method in methods.items():
        ready = None if name == OURS else float  # in a message they are float32, and read-only
        spent[name] = np.array([cpu_ms(method, np.array(points, ready), p) for points, p in scans])
    return spent


def print_flight(title: str, flight: Recording, config: Config) -> None:
    """Print the times of a flight, and the ratio of our median to that of the loop."""
    mapper = Mapper(config)
    spent = cpu_times(mapper, [scan[1:3] for scan in flight.scans])
    rows = []
    for name, ms in spent.items():
        median, most = np.percentile(ms, [50.0, 99.0])
        numbers = (ms[0], median, most, ms.max(), ms.sum())
        ratio = np.median(spent[OURS]) / median
        rows.append([name, *(f"{value:.2f}" for value in numbers), f"{ratio:.2f}"])
    table(
        f"{title}: {len(flight.scans)} scans, {mapper.leaves.count} leaves",
        ["ms", "first", "median", "99 %", "worst", "all scans", "ours is times"],
        rows,
    )


def wave_scan(side: int, stamp: int, rng: np.random.Generator, extent: float = 60.0):
    """Organised scan of ``side`` squared points of gentle waves, from 450 m above."""
    step = (np.arange(side) + 0.5) / side * extent - 0.5 * extent
    x, y = np.meshgrid(step, step)
    z = 0.1 * np.sin(0.7 * x) * np.sin(0.5 * y)
    seen = np.stack([x, -y, 450.0 - z], axis=-1)
    distance = np.linalg.norm(seen, axis=-1, keepdims=True)
    seen *= 1.0 + 0.06 * rng.standard_normal(distance.shape) / distance
    sigma = np.diag([1e-3] * 3 + [1e-8] * 3)
    return seen, Pose(stamp, np.array([0.0, 0.0, 450.0]), np.diag([1.0, -1.0, -1.0]), sigma)


def growth_with_points(sides: list[int]) -> None:
    """Print times for growing scans."""
    rng = np.random.default_rng(1)
    rows = []
    for side in sides:
        scans = [wave_scan(side, k, rng) for k in range(4)]
        mapper = Mapper(configuration("morpheus"))
        spent = cpu_times(mapper, scans)
        points, pose = wave_scan(side, 9, rng)
        loose = cpu_ms(mapper.update, points.reshape(-1, 3), pose)
        rows.append([f"{side * side:,}", mapper.leaves.count, *growth(spent), f"{loose:.2f}"])
    table(
        "Growth with points: 64 x 64 m, leaves of 4 to 0.25 m, ms",
        ["points", "leaves", *GROWTH, "not organised"],
        rows,
    )


def growth_with_leaves() -> None:
    """Print times for growing numbers of leaves."""
    rng = np.random.default_rng(2)
    scans = [wave_scan(128, k, rng, 63.9) for k in range(6)]
    rows = []
    for level in LEVELS:
        config = configuration("morpheus", domain__min_level=level, domain__max_level=level)
        spent = cpu_times(Mapper(config), scans)
        rows.append([f"{4**level:,}", f"{64.0 / 2**level:g}", *growth(spent)])
    table(
        "Growth with leaves: 16,384 points over leaves of one size, ms",
        ["leaves", "size m", *GROWTH],
        rows,
    )


GROWTH = ("first", "later", "loop")


def growth(spent: dict[str, np.ndarray]) -> list[str]:
    """Our first scan, and medians of the later scans: ours, then those of the loop."""
    later = [np.median(ms[1:]) for ms in spent.values()]
    return [f"{value:.2f}" for value in (spent[OURS][0], *later)]


if __name__ == "__main__":
    main()
