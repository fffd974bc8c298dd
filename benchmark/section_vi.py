# SPDX-License-Identifier: Apache-2.0
"""Section VI of the paper: quadtree and fixed resolution on the same scans.

The default seeds were not used for tuning (studies/RESULTS.md).
"""

from __future__ import annotations

import argparse
import sys
from operator import attrgetter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
from common import MapScore, configuration, machine, recording, score, table
from common.consistency import Counts


def main() -> None:
    """Map the flights and print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(101, 111)))
    parser.add_argument("--duration", type=float, help="duration of each flight, s")
    parser.add_argument("--terrain", help="an elevation model to fly over")
    options = parser.parse_args()
    quadtree, fixed = configuration("parabola"), configuration("parabola", "parabola_fixed")
    print(machine())
    tree: list[MapScore] = []
    grid: list[MapScore] = []
    for seed in options.seeds:
        flight = recording("parabola", seed, options.duration, options.terrain)
        tree.append(score(flight, quadtree))
        grid.append(score(flight, fixed))
        recording.cache_clear()
    summary(tree, grid)


def summary(tree: list[MapScore], grid: list[MapScore]) -> None:
    """Print means over the flights beside the figures of the paper."""

    def both(measure, form: str, paper: tuple[str, str], pick=np.mean) -> list[str]:
        values = [pick([measure(s) for s in scores]) for scores in (tree, grid)]
        return [*(format(v, form) for v in values), *paper]

    fractions = [sum((s.counts for s in scores), Counts()) for scores in (tree, grid)]
    none, error = ("-", "-"), attrgetter("elevation.mean_absolute")
    within = attrgetter("elevation.mean_absolute_mean_removed")
    greatest, leaves = attrgetter("elevation.maximum"), attrgetter("leaves")

    def empty(of: MapScore) -> float:
        return 100.0 * of.elevation.without_estimate

    rows = [
        ["leaves with an estimate, mean", *both(leaves, ".0f", ("232", "2852"))],
        ["  most", *both(leaves, ".0f", none, max)],
        ["elevation error, mean, m", *both(error, ".3f", none)],
        ["  its share from within flights, m", *both(within, ".3f", none)],
        ["  greatest of all flights, m", *both(greatest, ".2f", ("< 3", "> 3"), max)],
        ["cells with points without estimate, worst, %", *both(empty, ".3f", none, max)],
        ["time of all scans, mean, s", *both(attrgetter("seconds"), ".3f", ("187", "220"))],
        ["  slowest scan, ms", *both(lambda s: s.scan_ms.max(), ".1f", none, max)],
        ["prefit below 95 %, one degree, %", *percent(c.shares[0] for c in fractions)],
        ["prefit above 95 %, one degree, %", *percent(c.shares[1] for c in fractions)],
    ]
    ratio = np.divide(*(np.mean([error(s) for s in scores]) for scores in (tree, grid)))
    table(
        f"{len(tree)} flights (the paper: one)",
        ["", "quadtree", "fixed", "paper quadtree", "paper fixed"],
        rows,
    )
    faster = np.mean([a.seconds < b.seconds for a, b in zip(tree, grid, strict=True)])
    text = f"elevation error {ratio:.2f}, faster in {faster:.0%} of the flights"
    print(f"\nquadtree over fixed: {text}")


def percent(fractions) -> list[str]:
    """Two fractions in per cent; the paper gives none for Section VI."""
    return [*(f"{100.0 * f:.2f}" for f in fractions), "-", "-"]


if __name__ == "__main__":
    main()
